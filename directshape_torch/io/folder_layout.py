"""A plain folder for a stereo rig of one's own: left, right, `rig.json`, and one JSON a frame (docs/inputs.md)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.files.text_files import Line
from directshape_torch.io.coco_segmentation import decode_segmentation
from directshape_torch.io.folder_json import FolderFrame, FolderObject, FolderRig, read_frame, read_rig
from directshape_torch.io.frame_detections import GivenMasks
from directshape_torch.io.frame_layout import FrameLayout, existing_folder
from directshape_torch.io.ground_plane_files import upright_plane
from directshape_torch.io.image_files import find_image
from directshape_torch.io.instance_masks import (
    SIDES,
    InstanceMask,
    MaskSource,
    Side,
    check_count,
    read_soft_mask,
    tight_box,
)
from directshape_torch.io.kitti_calibration import KittiCalibration, to_stereo_camera
from directshape_torch.io.kitti_labels import KittiObject, parse_object, poses_cam
from directshape_torch.io.mask_files import COCO_CAR_IDS
from directshape_torch.scene_check.image_boxes import project_boxes

_CAR = "Car"
_OTHER_CATEGORY = 0
# KITTI's numbers for what a line does not have.
_NO_BOX_3D = "-1 -1 -1 -1000 -1000 -1000 -10"


class FolderLayout(FrameLayout):
    """`root/left`, `root/right`, `root/rig.json` and `root/frames/ID.json`; labels, planes and masks are in the latter.

    The frame of boxes and planes is the left camera's: `ref` is `cam`.

    Args:
        root: the folder.
        frames_dir: folder of the frames' JSON files; default `root/frames`.

    Raises:
        DataFormatError: a folder is missing.
    """

    detection_file_name = "ID.json"

    def __init__(self, root: Path | str, frames_dir: Path | str | None = None) -> None:
        self.root = Path(root)
        for name in ("left", "right"):
            existing_folder(self.root / name, "is no folder of images", "see docs/inputs.md, or give another --layout")
        self.detections_dir = existing_folder(
            self.root / "frames" if frames_dir is None else Path(frames_dir), "is no folder of frames"
        )

    @cached_property
    def rig(self) -> FolderRig:
        """The rig of all frames."""
        return read_rig(self.root / "rig.json")

    def frame_ids(self) -> list[str]:
        """Every frame that has a JSON file."""
        return sorted(path.stem for path in self.detections_dir.glob("*.json"))

    def frame_id(self, number: int) -> str:
        """The frame whose name is that number, with leading zeros or without."""
        names = [name for name in self.frame_ids() if name.isdecimal() and int(name) == number]
        if not names:
            raise InputError("frames", f"numbers of files in {self.detections_dir}", str(number))
        return names[0]

    def images(self, frame_id: str) -> tuple[Path, Path]:
        """Left and right image."""
        return find_image(self.root / "left", frame_id), find_image(self.root / "right", frame_id)

    def calibration_path(self, frame_id: str) -> Path:
        """One calibration for all."""
        return self.root / "rig.json"

    def calibration(self, frame_id: str) -> KittiCalibration:
        """The projections of the rig, with the left camera's frame as `ref`."""
        rig = self.rig
        P2 = np.concatenate([rig.K_left, np.zeros((3, 1))], axis=1)
        P3 = np.concatenate([rig.K_right, (rig.K_right @ rig.t_right_cam)[:, None]], axis=1)
        return KittiCalibration(rig.path, P2, P3)

    def plane_path(self, frame_id: str) -> Path | None:
        """The frame's file, where it holds a plane."""
        frame = self._frame(frame_id)
        return None if frame.ground_plane_cam is None else frame.path

    def plane_ref(self, frame_id: str) -> NDArray[np.float64]:
        """(a, b, c, d) in the left camera's frame."""
        frame = self._frame(frame_id)
        if frame.ground_plane_cam is None:
            raise DataFormatError(frame.path, "holds no 'ground_plane'", cure="add it, or use --ground auto")
        return upright_plane(frame.path, np.array(frame.ground_plane_cam))

    def detection_path(self, frame_id: str) -> Path:
        """One file a frame."""
        return self.detections_dir / f"{frame_id}.json"

    def objects(self, frame_id: str) -> list[KittiObject]:
        """The entries of `objects` as KITTI's lines, in which results are written."""
        frame = self._frame(frame_id)
        return [self._kitti_object(frame.path, number, entry, True) for number, entry in enumerate(frame.objects, 1)]

    def labels(self, frame_id: str) -> list[KittiObject] | None:
        """The entries of `labels`, where there are any."""
        frame = self._frame(frame_id)
        if frame.labels is None:
            return None
        return [self._kitti_object(frame.path, number, entry, False) for number, entry in enumerate(frame.labels, 1)]

    def sequence_of(self, frame_id: str) -> str:
        """All frames are of one drive."""
        return ""

    def times_s(self, frame_id: str) -> tuple[float, float] | None:
        """Those of the frame's file, where it has them."""
        return self._frame(frame_id).times_s

    def masks(self, directory: Path | None) -> MaskSource | None:
        """Those of the frames' files, unless a folder of others is given."""
        return FolderMasks(self.root, self.detections_dir) if directory is None else super().masks(directory)

    def given_masks(self, frame_id: str) -> GivenMasks | None:
        """Each object carries its masks."""
        objects = self._frame(frame_id).objects
        return {side: [-1 if o.masks[side] is None else row for row, o in enumerate(objects)] for side in SIDES}

    def _frame(self, frame_id: str) -> FolderFrame:
        return read_frame(self.detection_path(frame_id))

    def _kitti_object(self, path: Path, number: int, entry: FolderObject, with_score: bool) -> KittiObject:
        line = f"{entry.object_class} -1 -1 {self._columns(path, entry)}"
        text = f"{line} {entry.score!r}" if with_score else line
        return replace(parse_object(path, Line(number, text, text)), track_id=entry.track_id)

    def _columns(self, path: Path, entry: FolderObject) -> str:
        """Observation angle, 2D box and 3D box of a line."""
        if entry.hwl is None or entry.bottom_center_cam is None or entry.rotation_y is None:
            return f"-10 {_words(entry.box_2d or (0.0, 0.0, 0.0, 0.0))} {_NO_BOX_3D}"
        x, _, z = entry.bottom_center_cam
        alpha = math.remainder(entry.rotation_y - math.atan2(x, z), 2 * math.pi)
        box_3d = _words((*entry.hwl, *entry.bottom_center_cam, entry.rotation_y))
        box_2d = entry.box_2d or self._projected(path, box_3d)
        return f"{alpha!r} {_words(box_2d)} {box_3d}"

    def _projected(self, path: Path, box_3d: str) -> tuple[float, ...]:
        """The 2D box around a 3D box, for objects that give none."""
        camera = to_stereo_camera([self.calibration("")], dtype=torch.float64)
        line = f"{_CAR} -1 -1 0 0 0 0 0 {box_3d}"
        found = parse_object(path, Line(1, line, line))
        width, height = self.rig.image_size_wh
        left, _ = project_boxes(
            poses_cam([found], camera.t_cam_ref[0]), torch.tensor([found.hwl]), camera, (height, width)
        )
        return tuple(float(value) for value in left[0])


@dataclass(frozen=True)
class FolderMasks:
    """The masks in `frames/ID.json`: the path of an 8-bit PNG from the data's folder, or a COCO segmentation.

    Attributes:
        root: paths of PNG files start here.
        frames_dir: folder of the JSON files.
    """

    root: Path
    frames_dir: Path

    def read(self, frame_id: str, size_hw: tuple[int, int]) -> list[InstanceMask]:
        frame = read_frame(self.frames_dir / f"{frame_id}.json")
        check_count(frame.path, len(frame.objects), size_hw)
        found = [
            self._mask(frame.path, index, entry, side, size_hw)
            for side in SIDES
            for index, entry in enumerate(frame.objects)
            if entry.masks[side] is not None
        ]
        return [mask for mask in found if mask is not None]

    def files(self, frame_id: str) -> tuple[Path, ...]:
        objects = read_frame(self.frames_dir / f"{frame_id}.json").objects
        named = [entry.masks[side] for side in SIDES for entry in objects]
        return tuple(dict.fromkeys(self.root / mask for mask in named if isinstance(mask, str)))

    def _mask(
        self, path: Path, index: int, entry: FolderObject, side: Side, size_hw: tuple[int, int]
    ) -> InstanceMask | None:
        probability = self._probability(path, index, entry, side, size_hw)
        mask_box = tight_box(probability)
        if mask_box is None:
            return None
        is_car = entry.object_class == _CAR
        category = min(COCO_CAR_IDS) if is_car else _OTHER_CATEGORY
        box = entry.box_2d if side == "left" and entry.box_2d is not None else mask_box
        return InstanceMask(side, index, category, is_car, box, mask_box, probability, entry.score)

    def _probability(
        self, path: Path, index: int, entry: FolderObject, side: Side, size_hw: tuple[int, int]
    ) -> NDArray[np.bool_] | NDArray[np.float32]:
        mask = entry.masks[side]
        if isinstance(mask, str):
            return read_soft_mask(self.root / mask, size_hw)
        return decode_segmentation(path, f"mask_{side} of objects[{index}]", mask, size_hw)


def _words(values: tuple[float, ...]) -> str:
    return " ".join(repr(value) for value in values)
