"""Stereo frames from files of any layout, with detections and masks, as the tensors a refinement takes."""

from __future__ import annotations

import contextlib
import copy
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Self, TypedDict, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.errors import DirectShapeError, InputError, shown
from directshape_torch.files.names import is_frame_id
from directshape_torch.files.text_files import read_lines
from directshape_torch.geometry.disparity_field import DisparityField
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.io.frame_detections import build_detections
from directshape_torch.io.frame_layout import FrameLayout, existing_folder
from directshape_torch.io.image_files import read_disparity, read_pair
from directshape_torch.io.instance_masks import MaskSource
from directshape_torch.io.kitti_calibration import camera_of_rig, plane_ref_to_cam, to_stereo_camera
from directshape_torch.io.kitti_labels import KittiObject
from directshape_torch.io.stereo_dataset import GroundSource, LoadedFrame
from directshape_torch.io.track_association import associate
from directshape_torch.io.velodyne import in_image, read_scan
from directshape_torch.scene import FrameBatch, GroundPlane
from directshape_torch.stereo_matching.plane_from_points import estimate_ground_plane


class DatasetOptions(TypedDict, total=False):
    """The keyword arguments of `FileStereoDataset`, for functions that pass them on."""

    split: Path | str | None
    frames: Iterable[str | int] | None
    classes: Sequence[str]
    ground: GroundSource
    camera_height_m: float
    disparity_field: DisparityField | Sequence[DisparityField] | None
    disparity_dir: Path | str | None
    lidar_dir: Path | str | None
    tracks: bool
    dtype: torch.dtype


class FileStereoDataset:
    """Frames with detections and masks, whose files a layout finds.

    Args:
        layout: where the parts of a frame are.
        masks: folder of masks (see `mask_source`), a `MaskSource`, or None: those of the layout, if it has any.
        split: file with one frame id a line; default every frame that has detections.
        frames: ids of the frames to use, of those.
        classes: object types to refine; other lines are copied.
        ground: where ground planes come from: "auto" is file, else stereo, else camera height; with a disparity
            field stereo comes first, for plane files share the bias of the disparities they were made from.
        camera_height_m: height of the camera above a level ground, the last resort.
        disparity_field: residual disparity of the rig, of several rigs, or None.
        disparity_dir: folder of `NNNNNN.png` (or `NNNNNN_10.png`) with the disparity maps of any stereo method, for the
            methods that fit a point cloud; None: they match the images themselves.
        lidar_dir: folder of KITTI's LiDAR scans `NNNNNN.bin`, which the calibration of the frames places; None: frames
            come without points.
        tracks: number the cars over the frames of a sequence (`Detections.track_id`): by the detection files, else by
            the masks of KITTI MOTS, else by `associate`; with times and camera poses of the frames where there are any.
        dtype: of the tensors.

    Raises:
        DataFormatError: a folder or the split file is missing.
        InputError: no frames, frames without a detection file, an unknown `ground`, or tracks in a layout without
            sequences.
    """

    def __init__(
        self,
        layout: FrameLayout,
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
    ) -> None:
        if ground not in get_args(GroundSource):
            raise InputError("ground", f"one of {', '.join(get_args(GroundSource))}", repr(ground))
        self.layout, self.detections_dir = layout, layout.detections_dir
        # Masks from elsewhere know nothing of the layout's own links between masks and detections.
        self._own_masks = masks is None
        if masks is None or isinstance(masks, (str, Path)):
            self.masks = layout.masks(None if masks is None else Path(masks))
        else:
            self.masks = masks
        self.classes = frozenset(classes)
        self.ground: GroundSource = ground
        self.camera_height_m = camera_height_m
        self.disparity_fields = _as_fields(disparity_field)
        self.disparity_dir = (
            None if disparity_dir is None else existing_folder(Path(disparity_dir), "is no folder of disparity maps")
        )
        self.lidar_dir = None if lidar_dir is None else existing_folder(Path(lidar_dir), "is no folder of LiDAR scans")
        self.dtype = dtype
        self.frame_ids = self._choose_frames(split, frames)
        self.tracks = tracks
        if tracks and self.layout.sequence_of(self.frame_ids[0]) is None:
            raise InputError("tracks", "a layout of sequences: tracking, raw or folder", "frames by themselves")
        self._tracks: dict[str | None, dict[str, list[int]]] = {}

    def __len__(self) -> int:
        return len(self.frame_ids)

    def load(self, frame_id: str) -> LoadedFrame:
        """Read everything of one frame.

        Raises:
            DataFormatError: a file is missing or damaged; names file and reason.
        """
        left, right = read_pair(*self.layout.images(frame_id))
        height, width = left.shape[:2]
        camera = camera_of_rig(self.layout.calibration(frame_id), self.disparity_fields, (width, height), self.dtype)
        time_s, T_world_cam = self._motion(frame_id, camera)
        frame = FrameBatch(
            images_left=_to_tensor(left, self.dtype),
            images_right=_to_tensor(right, self.dtype),
            sizes=torch.tensor([[height, width]]),
            camera=camera,
            ground=self._ground(frame_id, left, right, camera),
            frame_ids=(frame_id,),
            disparity=self._disparity(frame_id, (height, width)),
            points_cam=self._points(frame_id, (height, width)),
            time_s=time_s,
            T_world_cam=T_world_cam,
        )
        objects = self.objects(frame_id)
        masks = [] if self.masks is None else self.masks.read(frame_id, (height, width))
        given = self.layout.given_masks(frame_id) if self._own_masks else None
        detections, rows, mask_tracks = build_detections(objects, masks, camera, (height, width), self.classes, given)
        if self.tracks:
            detections = replace(detections, track_id=self._track_id(frame_id, rows, mask_tracks))
        sequence = self.sequence_of(frame_id)
        return LoadedFrame(frame, detections, objects, rows, self.layout.labels(frame_id), sequence)

    def scan(self, frame_id: str) -> tuple[Tensor, StereoCamera]:
        """All points (P, 3) of the LiDAR scan of a frame in its left camera, metres, float64, and that camera.

        The camera has no disparity field: a scan has no part in the rig's error.

        Raises:
            DataFormatError: the scan is missing or damaged, or the calibration does not say where the scanner is.
            InputError: the data set was opened without scans.
        """
        if self.lidar_dir is None:
            raise InputError("dataset", "one with LiDAR scans", "none", "open it with lidar_dir=..")
        calibration = self.layout.lidar_calibration(frame_id)
        camera = to_stereo_camera([calibration], dtype=torch.float64)
        return read_scan(self.layout.lidar_files(self.lidar_dir, frame_id)["lidar"], calibration, camera), camera

    def changed(
        self, *, ground: GroundSource, disparity_field: DisparityField | Sequence[DisparityField] | None
    ) -> Self:
        """The same frames with planes from elsewhere and other fields."""
        other = copy.copy(self)
        other.ground, other.disparity_fields = ground, _as_fields(disparity_field)
        return other

    def objects(self, frame_id: str) -> list[KittiObject]:
        """The detections of a frame alone, without its images."""
        return self.layout.objects(frame_id)

    def sequence_of(self, frame_id: str) -> str | None:
        """The sequence through which the tracks of a frame go, "" where there is but one; None: it has no tracks."""
        return self.layout.sequence_of(frame_id) if self.tracks else None

    def detection_path(self, frame_id: str) -> Path:
        """The file that holds the detections of a frame."""
        return self.layout.detection_path(frame_id)

    def input_files(self, frame_id: str) -> dict[str, Path]:
        """The files that `load` reads for a frame and that bear on its result, by their role."""
        left, right = self.layout.images(frame_id)
        files = {
            "image_left": left,
            "image_right": right,
            "calibration": self.layout.calibration_path(frame_id),
            "detections": self.detection_path(frame_id),
        }
        if self.disparity_dir is not None:
            files["disparity"] = self.layout.disparity_path(self.disparity_dir, frame_id)
        if self.lidar_dir is not None:
            files |= self.layout.lidar_files(self.lidar_dir, frame_id)
        if self.tracks:
            files |= self.layout.motion_files(frame_id)
        plane = self.layout.plane_path(frame_id)
        if self.ground in ("auto", "file") and plane is not None:
            files["ground_plane"] = plane
        if self.masks is not None:
            files |= {f"masks_{index}": path for index, path in enumerate(self.masks.files(frame_id))}
        return files

    def _track_id(self, frame_id: str, rows: tuple[int, ...], mask_tracks: tuple[int, ...]) -> Tensor:
        """(B,) of the detections: by the masks, else by the detections themselves."""
        if any(track >= 0 for track in mask_tracks):
            return torch.tensor(mask_tracks)
        sequence = self.sequence_of(frame_id)
        if sequence not in self._tracks:
            self._tracks[sequence] = self._tracks_of(sequence)
        ids = self._tracks[sequence][frame_id]
        return torch.tensor([track for track, row in zip(ids, rows, strict=True) if row >= 0], dtype=torch.int64)

    def _tracks_of(self, sequence: str | None) -> dict[str, list[int]]:
        """Of all frames of a sequence, whichever of them are used: those of its files, or associated."""
        objects: dict[str, list[KittiObject]] = {}
        for frame_id in self.layout.frame_ids():
            if self.layout.sequence_of(frame_id) == sequence:
                # A file that cannot be read is reported when its turn comes.
                with contextlib.suppress(DirectShapeError, OSError):
                    objects[frame_id] = self.objects(frame_id)
        given = {frame_id: [found.track_id for found in frame] for frame_id, frame in objects.items()}
        if any(track >= 0 for ids in given.values() for track in ids):
            return given
        return dict(zip(objects, associate(list(objects.values())), strict=True))

    def _choose_frames(self, split: Path | str | None, frames: Iterable[str | int] | None) -> tuple[str, ...]:
        if split is not None:
            known = list(dict.fromkeys(line.text for line in read_lines(split)))
        else:
            known = self.layout.frame_ids()
        if frames is not None:
            names = (self.layout.frame_id(frame) if isinstance(frame, int) else frame for frame in frames)
            # A frame that is named twice is one frame.
            wanted, existing = list(dict.fromkeys(names)), set(known)
            missing = [frame for frame in wanted if frame not in existing]
            if missing:
                where = split if split is not None else self.detections_dir
                raise InputError("frames", f"ids that occur in {where}", ", ".join(missing[:5]))
            known = wanted
        if not known:
            wanted_file = self.layout.detection_file_name
            where = f"detection file {wanted_file} in {self.detections_dir}" if split is None else f"frame in {split}"
            raise InputError("frames", f"at least one {where}", "none")
        for frame_id in known:
            if not is_frame_id(frame_id):
                where = "frames" if split is None else f"{split}, frames"
                raise InputError(where, "names without folders", shown(frame_id), "rename the files")
        return tuple(known)

    def _disparity(self, frame_id: str, size_hw: tuple[int, int]) -> Tensor | None:
        if self.disparity_dir is None:
            return None
        disparity = read_disparity(self.layout.disparity_path(self.disparity_dir, frame_id), size_hw)
        return torch.from_numpy(disparity)[None].to(self.dtype)

    def _points(self, frame_id: str, size_hw: tuple[int, int]) -> Tensor | None:
        if self.lidar_dir is None:
            return None
        points, camera = self.scan(frame_id)
        return in_image(points, size_hw, camera)[None].to(self.dtype)

    def _motion(self, frame_id: str, camera: StereoCamera) -> tuple[Tensor | None, Tensor | None]:
        """Time (1,) and pose (1, 4, 4) of the left camera, where cars have numbers and that is known."""
        time_s, T_world_ref = self.layout.motion(frame_id) if self.tracks else (None, None)
        T_world_cam = None
        if T_world_ref is not None:
            T_world_cam = torch.from_numpy(T_world_ref)[None].clone()
            T_world_cam[:, :3, 3] -= (T_world_cam[:, :3, :3] @ camera.t_cam_ref[0].double()[:, None])[:, :, 0]
            T_world_cam = T_world_cam.to(self.dtype)
        return None if time_s is None else torch.tensor([time_s], dtype=self.dtype), T_world_cam

    def _ground(
        self, frame_id: str, left: NDArray[np.uint8], right: NDArray[np.uint8], camera: StereoCamera
    ) -> GroundPlane:
        """The plane of the first source that has one, of those that `self.ground` allows.

        Plane files are commonly made from raw disparity and share its bias, so with a disparity field "auto" asks the
        corrected stereo pair first.
        """
        orders: dict[GroundSource, tuple[GroundSource, ...]] = {
            "auto": ("file", "stereo") if not self.disparity_fields else ("stereo", "file"),
            "file": ("file",),
            "stereo": ("stereo",),
            "camera_height": (),
        }
        for source in orders[self.ground]:
            if source == "file":
                plane_cam = self._plane_from_file(frame_id, camera)
            else:
                plane_cam = estimate_ground_plane(left, right, camera)
            if plane_cam is not None:
                normal, offset = (torch.as_tensor(part).double().to(self.dtype) for part in plane_cam)
                return GroundPlane(normal.reshape(1, 3), offset.reshape(1), (source,))
        return GroundPlane.from_camera_height(self.camera_height_m).to(dtype=self.dtype)

    def _plane_from_file(self, frame_id: str, camera: StereoCamera) -> tuple[Tensor, Tensor] | None:
        if self.ground == "auto" and self.layout.plane_path(frame_id) is None:
            return None
        plane_ref = torch.from_numpy(self.layout.plane_ref(frame_id))
        return plane_ref[:3], plane_ref_to_cam(plane_ref[:3], plane_ref[3], camera.t_cam_ref[0].double())


def _as_fields(fields: DisparityField | Sequence[DisparityField] | None) -> tuple[DisparityField, ...]:
    if fields is None:
        return ()
    return (fields,) if isinstance(fields, DisparityField) else tuple(fields)


def _to_tensor(rgb: NDArray[np.uint8], dtype: torch.dtype) -> Tensor:
    """(1, 3, H, W) in [0, 1] from uint8 (H, W, 3)."""
    return torch.from_numpy(rgb).permute(2, 0, 1)[None].to(dtype).contiguous() / 255
