"""What is known of each detected car in the image, to hold its 3D box against."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from directshape_torch.data_check.frame_parts import FrameParts
from directshape_torch.io.instance_masks import InstanceMask, Side
from directshape_torch.io.mask_matching import MaskMatches, match_masks
from directshape_torch.scene import StereoCamera


@dataclass(frozen=True)
class CarBoxes:
    """N boxes as their files give them.

    Attributes:
        location: (N, 3) metres.
        hwl: (N, 3) the three lengths in the order of the file, metres.
        rotation_y: (N,) radians, or what stands there.
        alpha: (N,) radians, or what stands there.
        box_2d: (N, 4) u_min, v_min, u_max, v_max, or what stands there, pixels.
    """

    location: NDArray[np.float64]
    hwl: NDArray[np.float64]
    rotation_y: NDArray[np.float64]
    alpha: NDArray[np.float64]
    box_2d: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.location)


@dataclass(frozen=True)
class FrameEvidence:
    """The boxes of a frame and the masks that cover their 2D boxes.

    Attributes:
        frame_id: its name.
        boxes: of N cars.
        masks: of the frame, by side, those of cars only.
        matches: for each side the masks that match the 2D boxes of the left image.
        camera: of the frame.
        size_hw: of its images.
        has_masks: whether the frame's masks could be read.
    """

    frame_id: str
    boxes: CarBoxes
    masks: dict[Side, list[InstanceMask]]
    matches: dict[Side, MaskMatches]
    camera: StereoCamera
    size_hw: tuple[int, int]
    has_masks: bool

    @property
    def mask_boxes(self) -> NDArray[np.float64]:  # (N, 4)
        """Around the left mask of each car, pixels, NaN where it has none."""
        boxes = np.full((len(self.boxes), 4), np.nan)
        for car, index in enumerate(self.matches["left"].mask_of_detection):
            if index >= 0:
                boxes[car] = self.masks["left"][index].mask_box
        return boxes


def gather_evidence(parts: FrameParts) -> FrameEvidence | None:
    """The evidence of a frame, or None where its images or its calibration cannot be used.

    Masks are matched by 2D boxes alone, for the 3D ones are what is in question. Those of the right image are held
    against the same boxes, where they should fit less well.
    """
    if parts.camera is None or parts.size_hw is None:
        return None
    boxes = CarBoxes(
        _columns([o.location_ref for o in parts.objects], 3),
        _columns([o.hwl for o in parts.objects], 3),
        np.array([o.rotation_y for o in parts.objects], dtype=np.float64),
        np.array([o.alpha for o in parts.objects], dtype=np.float64),
        _columns([o.box_2d for o in parts.objects], 4),
    )
    of_cars = [mask for mask in parts.masks or [] if mask.is_car]
    masks: dict[Side, list[InstanceMask]] = {
        "left": [mask for mask in of_cars if mask.side == "left"],
        "right": [mask for mask in of_cars if mask.side == "right"],
    }
    matches = {side: match_masks(boxes.box_2d, of_side) for side, of_side in masks.items()}
    has_masks = parts.masks is not None
    return FrameEvidence(parts.frame_id, boxes, masks, matches, parts.camera, parts.size_hw, has_masks)


def _columns(rows: Sequence[tuple[float, ...]], count: int) -> NDArray[np.float64]:
    return np.array(rows, dtype=np.float64).reshape(-1, count)
