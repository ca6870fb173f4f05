"""This module loads stereo data sets of any layout, with detections and masks, frame by frame as tensors."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.errors import DirectShapeError, InputError
from directshape_torch.geometry.disparity_field import DisparityField
from directshape_torch.geometry.ground_plane import GroundPlane
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.io.frame_choice import chosen_frames
from directshape_torch.io.frame_detections import STARTED_CLASS, build_detections, detections_of_masks
from directshape_torch.io.frame_layout import FrameFiles, FrameLayout, existing_folder
from directshape_torch.io.image_files import read_disparity, read_pair
from directshape_torch.io.instance_masks import MaskSource
from directshape_torch.io.kitti_calibration import camera_of_rig, plane_ref_to_cam, to_stereo_camera
from directshape_torch.io.kitti_labels import KittiObject
from directshape_torch.io.layouts import (
    folder_layout,
    object_layout,
    odometry_layout,
    raw_layout,
    stereo2015_layout,
    tracking_layout,
)
from directshape_torch.io.mask_files import LayoutMasks
from directshape_torch.io.mask_matching import with_image_boxes
from directshape_torch.io.track_association import associate
from directshape_torch.io.velodyne import in_image, read_scan
from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import FrameBatch
from directshape_torch.stereo_matching.plane_from_points import estimate_ground_plane

GroundSource = Literal["auto", "file", "stereo", "camera_height"]
LayoutName = Literal["kitti", "raw", "tracking", "odometry", "stereo2015", "folder"]
# The first pair of a scene is `NNNNNN_10.png` in submissions to KITTI Stereo 2015; other frames are `NNNNNN.png`.
_DISPARITIES = ("_10.png", ".png")
_LAYOUTS: dict[LayoutName, Callable[..., FrameLayout]] = {
    "kitti": object_layout,
    "raw": raw_layout,
    "tracking": tracking_layout,
    "odometry": odometry_layout,
    "stereo2015": stereo2015_layout,
    "folder": folder_layout,
}


@dataclass(frozen=True)
class LoadedFrame:
    """A `LoadedFrame` is one frame of a data set, ready for a refinement.

    Attributes:
        frame: a batch of one frame.
        detections: the B objects to refine, with masks.
        input_objects: every line of the detection file, in its order.
        refined_rows: for each input line the index of its detection, or -1 for lines that are copied unchanged.
        labels: the ground truth, or None if there is no label file.
        sequence: sequence of the tracks of the detections; see `StereoDataset.sequence_of`.
        no_mask_reasons: for each detection why it has no left mask, else "".
    """

    frame: FrameBatch
    detections: Detections
    input_objects: list[KittiObject]
    refined_rows: tuple[int, ...]
    labels: list[KittiObject] | None
    sequence: str | None = None
    no_mask_reasons: tuple[str, ...] = ()

    @property
    def frame_id(self) -> str:
        return self.frame.frame_ids[0]

    @property
    def row_of_detection(self) -> tuple[int, ...]:
        """For each detection the index of its input line."""
        return tuple(row for row, detection in enumerate(self.refined_rows) if detection >= 0)

    @property
    def detected_objects(self) -> tuple[KittiObject, ...]:
        """For each detection its input line."""
        return tuple(self.input_objects[row] for row in self.row_of_detection)


def open_dataset(
    layout: LayoutName | FrameLayout,
    root: Path | str = ".",
    detections_dir: Path | str | None = None,
    masks: Path | str | MaskSource | None = None,
    *,
    split: Path | str | None = None,
    frames: Iterable[str | int] | None = None,
    classes: Sequence[str] = ("Car",),
    ground: GroundSource = "auto",
    camera_height_m: float = 1.65,
    disparity_field: DisparityField | Sequence[DisparityField] | None = None,
    disparity_dir: Path | str | None = None,
    lidar_dir: Path | str | None = None,
    tracks: bool = False,
    dtype: torch.dtype = torch.float32,
) -> StereoDataset:
    """The data set of a layout (docs/inputs.md).

    Args:
        layout: "kitti" (object benchmark), "raw", "tracking", "odometry", "stereo2015" or "folder"; or a user's own
            layout, which needs neither `root` nor `detections_dir`.
        root: folder of the data.
        detections_dir: folder of detections; None means for "folder" `root/frames`, if there is one, and else that the
            boxes are made of the masks (docs/no_boxes.md).
        masks: folder of masks (see `mask_source`), a text file of KITTI MOTS, or a `MaskSource`. None means the masks
            in the files of a "folder", and no masks in other layouts.
        split: file with one frame in each line: its id, number or image. Default: every frame that has detections, or
            without a folder of these every frame that has masks.
        frames: ids of the frames to use, out of the split.
        classes: object types to refine; other lines are copied.
        ground: source of ground planes. "auto" is file, else stereo, else camera height; with a disparity field stereo
            comes first, because plane files have the bias of the disparities that they were made from.
        camera_height_m: height of the camera above a level ground, if no plane is found.
        disparity_field: residual disparity of the rig, or of several rigs, or None.
        disparity_dir: folder of `NNNNNN.png` (or `NNNNNN_10.png`) with disparity maps of any stereo method, for
            settings that fit a point cloud. None means that the images are matched.
        lidar_dir: folder of KITTI's LiDAR scans `NNNNNN.bin`, whose pose is in the calibration of the frames. None
            means frames without points.
        tracks: whether to number the cars over the frames of a sequence (`Detections.track_id`): by the detection
            files, else by the masks of KITTI MOTS, else by `associate`. Frames then have times and camera poses if
            there are any.
        dtype: dtype of the tensors.

    Raises:
        DataFormatError: a folder or the split file is missing, or the data have another layout.
        InputError: the layout or `ground` is unknown, there are neither detections nor masks, or no frames, boxes of
            other classes than cars are to be made of masks, or `tracks` is used in a layout without sequences.
    """
    if isinstance(layout, str):
        layout = _named_layout(layout, root, detections_dir, masks is not None)
    if ground not in get_args(GroundSource):
        raise InputError("ground", f"one of {', '.join(get_args(GroundSource))}", repr(ground))
    frame_ids = chosen_frames(layout, split, frames)
    first = layout.files(frame_ids[0])
    if layout.detections_dir is None and STARTED_CLASS not in classes:
        raise InputError("classes", f"{STARTED_CLASS}, of which masks are", ", ".join(classes), "give detections, too")
    if tracks and layout.sequence_of(frame_ids[0]) is None:
        raise InputError("tracks", "a layout of sequences: tracking, odometry, raw or folder", "frames by themselves")
    source = _mask_source(layout, masks, first)
    if layout.detections_dir is None and split is None and frames is None and isinstance(source, LayoutMasks):
        frame_ids = _frames_with_masks(source, frame_ids)
    return StereoDataset(
        layout,
        source,
        frame_ids,
        frozenset(classes),
        ground,
        camera_height_m,
        (disparity_field,) if isinstance(disparity_field, DisparityField) else tuple(disparity_field or ()),
        _folder(disparity_dir, "disparity maps"),
        _folder(lidar_dir, "LiDAR scans"),
        tracks,
        dtype,
    )


def _named_layout(name: str, root: Path | str, detections_dir: Path | str | None, has_masks: bool) -> FrameLayout:
    if name not in _LAYOUTS:
        raise InputError("layout", f"one of {', '.join(_LAYOUTS)}", repr(name))
    layout = _LAYOUTS[name](root, detections_dir)
    if layout.detections_dir is None and not has_masks:
        expected = f"a folder of detections for the layout {name!r}"
        raise InputError("detections", expected, "none", "--detections DIR, or masks alone, of which boxes are made")
    return layout


def _mask_source(layout: FrameLayout, masks: Path | str | MaskSource | None, first: FrameFiles) -> MaskSource | None:
    """The masks that `open_dataset` was given, else the masks in the files of a plain folder."""
    if isinstance(masks, (str, Path)):
        is_text = Path(masks).is_file() and Path(masks).suffix.lower() == ".txt"
        return LayoutMasks(layout, Path(masks) if is_text else existing_folder(Path(masks), "is no folder of masks"))
    if masks is None and first.detections is not None and first.detections.suffix.lower() == ".json":
        return LayoutMasks(layout, None)
    return masks


def _frames_with_masks(masks: LayoutMasks, frame_ids: tuple[str, ...]) -> tuple[str, ...]:
    """The frames that have a file of masks; raises `InputError` if no frame has one."""
    found = tuple(filter(masks.has_file, frame_ids))
    if not found:
        expected = f"a left image with a file of masks in {masks.directory}"
        raise InputError("masks", expected, "none", "give their files the names of the images")
    return found


def _folder(path: Path | str | None, what: str) -> Path | None:
    return None if path is None else existing_folder(Path(path), f"is no folder of {what}")


@dataclass(eq=False)
class StereoDataset:
    """A `StereoDataset` has frames with detections and masks, whose files a layout finds; see `open_dataset`."""

    layout: FrameLayout
    masks: MaskSource | None
    frame_ids: tuple[str, ...]
    classes: frozenset[str]
    ground: GroundSource
    camera_height_m: float
    disparity_fields: tuple[DisparityField, ...]
    disparity_dir: Path | None
    lidar_dir: Path | None
    tracks: bool
    dtype: torch.dtype
    # Track numbers by sequence and frame, computed on first use.
    _tracks: dict[str | None, dict[str, list[int]]] = field(default_factory=dict, init=False, repr=False)

    def __len__(self) -> int:
        return len(self.frame_ids)

    @property
    def has_detections(self) -> bool:
        """Whether a detector gives the boxes; else they are made of the masks."""
        return self.layout.detections_dir is not None

    def load(self, frame_id: str) -> LoadedFrame:
        """Read all data of one frame.

        Raises:
            DataFormatError: a file is missing or damaged; the error names file and reason.
        """
        files = self.layout.files(frame_id)
        left, right = read_pair(files.left, files.right)
        height, width = left.shape[:2]
        camera = camera_of_rig(files.read_calibration(), self.disparity_fields, (width, height), self.dtype)
        time_s, T_world_cam = self._motion(files, camera)
        frame = FrameBatch(
            images_left=_to_tensor(left, self.dtype),
            images_right=_to_tensor(right, self.dtype),
            sizes=torch.tensor([[height, width]]),
            camera=camera,
            ground=self._ground(files, left, right, camera),
            frame_ids=(frame_id,),
            disparity=self._disparity(files, (height, width)),
            points_cam=self._points(frame_id, (height, width)),
            time_s=time_s,
            T_world_cam=T_world_cam,
        )
        masks = [] if self.masks is None else self.masks.read(frame_id, (height, width))
        if self.has_detections:
            objects = files.read_objects()
            found = build_detections(objects, masks, camera, (height, width), self.classes)
        else:
            found, objects = detections_of_masks(masks, frame)
        detections, rows = found.detections, found.rows
        if self.tracks:
            detections = replace(detections, track_id=self._track_id(frame_id, rows, found.tracks))
        sequence = self.sequence_of(frame_id)
        reasons = found.no_mask_reasons
        return LoadedFrame(frame, detections, objects, rows, files.read_labels(), sequence, reasons)

    def scan(self, frame_id: str) -> tuple[Tensor, StereoCamera]:
        """All points (P, 3) of a frame's LiDAR scan in its left camera, metres, float64, and that camera.

        The camera has no disparity field, because the scan is not affected by the rig's error.

        Raises:
            DataFormatError: the scan is missing or damaged, or the calibration lacks the pose of the scanner.
            InputError: the data set was opened without scans.
        """
        if self.lidar_dir is None:
            raise InputError("dataset", "one with LiDAR scans", "none", "open it with lidar_dir=..")
        files = self.layout.files(frame_id)
        calibration = files.read_lidar_calibration()
        return read_scan(files.within(self.lidar_dir, ".bin"), calibration), to_stereo_camera(calibration)

    def objects(self, frame_id: str) -> list[KittiObject]:
        """The detections of a frame, read without its images; there are none where boxes are made of masks."""
        return self.layout.files(frame_id).read_objects()

    def sequence_of(self, frame_id: str) -> str | None:
        """The sequence of the tracks of a frame, "" if there is only one, or None if the frame has no tracks."""
        return self.layout.sequence_of(frame_id) if self.tracks else None

    def input_files(self, frame_id: str) -> dict[str, Path]:
        """The files that `load` reads for a frame and that affect its result, by their role."""
        files = self.layout.files(frame_id)
        roles = {
            "image_left": files.left,
            "image_right": files.right,
            "calibration": files.calibration,
            "detections": files.detections,
            "disparity": self.disparity_dir and files.within(self.disparity_dir, *_DISPARITIES),
            "lidar": self.lidar_dir and files.within(self.lidar_dir, ".bin"),
            "lidar_calibration": self.lidar_dir and files.velo_to_cam,
            "times": files.times if self.tracks else None,
            "poses": files.trajectory if self.tracks else None,
            "ground_plane": files.plane if self.ground in ("auto", "file") and files.plane.is_file() else None,
        }
        if self.masks is not None:
            roles |= {f"masks_{index}": path for index, path in enumerate(self.masks.files(frame_id))}
        return {role: path for role, path in roles.items() if path is not None}

    def _track_id(self, frame_id: str, rows: tuple[int, ...], mask_tracks: tuple[int, ...]) -> Tensor:
        """Track numbers (B,) of the detections, by the masks if they have tracks, else by the detection files."""
        if any(track >= 0 for track in mask_tracks) or not self.has_detections:
            return torch.tensor(mask_tracks, dtype=torch.int64)
        sequence = self.sequence_of(frame_id)
        if sequence not in self._tracks:
            self._tracks[sequence] = self._tracks_of(sequence)
        ids = self._tracks[sequence][frame_id]
        return torch.tensor([track for track, row in zip(ids, rows, strict=True) if row >= 0], dtype=torch.int64)

    def _tracks_of(self, sequence: str | None) -> dict[str, list[int]]:
        """Track numbers of all frames of a sequence, also of unused ones, from its files or by association."""
        objects: dict[str, list[KittiObject]] = {}
        for frame_id in self.layout.frame_ids():
            if self.layout.sequence_of(frame_id) == sequence:
                # A file that cannot be read is reported when its frame is loaded.
                with contextlib.suppress(DirectShapeError, OSError):
                    objects[frame_id] = self._objects_in_image(frame_id)
        given = {frame_id: [found.track_id for found in frame] for frame_id, frame in objects.items()}
        if any(track >= 0 for ids in given.values() for track in ids):
            return given
        return dict(zip(objects, associate(list(objects.values())), strict=True))

    def _objects_in_image(self, frame_id: str) -> list[KittiObject]:
        """The detections of a frame with usable 2D boxes, read without its images."""
        camera = to_stereo_camera(self.layout.files(frame_id).read_calibration())
        # The principal point is near the middle of an image.
        width, height = (2 * int(x) for x in camera.K_left[0, :2, 2])
        return with_image_boxes(self.objects(frame_id), camera, (height, width))

    def _disparity(self, files: FrameFiles, size_hw: tuple[int, int]) -> Tensor | None:
        if self.disparity_dir is None:
            return None
        disparity = read_disparity(files.within(self.disparity_dir, *_DISPARITIES), size_hw)
        return torch.from_numpy(disparity)[None].to(self.dtype)

    def _points(self, frame_id: str, size_hw: tuple[int, int]) -> Tensor | None:
        if self.lidar_dir is None:
            return None
        points, camera = self.scan(frame_id)
        return in_image(points, size_hw, camera)[None].to(self.dtype)

    def _motion(self, files: FrameFiles, camera: StereoCamera) -> tuple[Tensor | None, Tensor | None]:
        """Time (1,) and pose (1, 4, 4) of the left camera if tracks are used and these are known, else None."""
        time_s, T_world_ref = files.read_motion() if self.tracks else (None, None)
        T_world_cam = None
        if T_world_ref is not None:
            T_world_cam = torch.from_numpy(T_world_ref)[None].clone()
            T_world_cam[:, :3, 3] -= (T_world_cam[:, :3, :3] @ camera.t_cam_ref[0].double()[:, None])[:, :, 0]
            T_world_cam = T_world_cam.to(self.dtype)
        return None if time_s is None else torch.tensor([time_s], dtype=self.dtype), T_world_cam

    def _ground(
        self, files: FrameFiles, left: NDArray[np.uint8], right: NDArray[np.uint8], camera: StereoCamera
    ) -> GroundPlane:
        """The plane of the first source that has one, in the order that `self.ground` selects."""
        orders: dict[GroundSource, tuple[GroundSource, ...]] = {
            "auto": ("file", "stereo") if not self.disparity_fields else ("stereo", "file"),
            "file": ("file",),
            "stereo": ("stereo",),
            "camera_height": (),
        }
        for source in orders[self.ground]:
            if source == "file":
                plane_cam = self._plane_from_file(files, camera)
            else:
                plane_cam = estimate_ground_plane(left, right, camera)
            if plane_cam is not None:
                normal, offset = (torch.as_tensor(part).double().to(self.dtype) for part in plane_cam)
                return GroundPlane(normal.reshape(1, 3), offset.reshape(1), (source,))
        return GroundPlane.from_camera_height(self.camera_height_m).to(dtype=self.dtype)

    def _plane_from_file(self, files: FrameFiles, camera: StereoCamera) -> tuple[Tensor, Tensor] | None:
        known = files.read_plane(needed=self.ground == "file")
        if known is None:
            return None
        plane_ref = torch.from_numpy(known)
        return plane_ref[:3], plane_ref_to_cam(plane_ref[:3], plane_ref[3], camera.t_cam_ref[0].double())


def _to_tensor(rgb: NDArray[np.uint8], dtype: torch.dtype) -> Tensor:
    """Image (1, 3, H, W) in [0, 1] from uint8 (H, W, 3)."""
    return torch.from_numpy(rgb).permute(2, 0, 1)[None].to(dtype).contiguous() / 255
