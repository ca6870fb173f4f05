"""2D boxes: corners, not corner and size."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from directshape_torch.scene_check.box_conventions import BoxConvention
from directshape_torch.scene_check.car_evidence import FrameEvidence
from directshape_torch.scene_check.convention_scores import project_conventions
from directshape_torch.scene_check.finding import Finding
from directshape_torch.scene_check.image_boxes import box_iou

MIN_GAIN = 0.15


def check_box_2d(frames: Sequence[FrameEvidence]) -> list[Finding]:
    """Whether `x y width height` fits the projected 3D boxes better than `u_min v_min u_max v_max`."""
    as_corners, as_size = [], []
    for frame in frames:
        projected = project_conventions(frame, [BoxConvention()])[0]
        for seen, box in zip(frame.boxes.box_2d, projected, strict=True):
            other = np.array([seen[0], seen[1], seen[0] + seen[2], seen[1] + seen[3]])
            both = box_iou(box[None], np.stack([seen, other]))[0]
            as_corners.append(both[0])
            as_size.append(both[1])
    if not as_corners or np.mean(as_size) <= np.mean(as_corners) + MIN_GAIN:
        return []
    return [
        Finding(
            "box_2d",
            "error",
            f"all frames, {len(as_corners)} cars",
            f"projected 3D boxes overlap 2D boxes by {np.mean(as_corners):.2f}, "
            f"and by {np.mean(as_size):.2f} when these are read as x y width height",
            "u_min v_min u_max v_max, pixels",
            "add x to the width and y to the height",
        )
    ]


def check_corners(frames: Sequence[FrameEvidence]) -> list[Finding]:
    """Whether 2D boxes end after they begin."""
    boxes = np.concatenate([frame.boxes.box_2d for frame in frames]) if frames else np.empty((0, 4))
    empty = int(np.sum((boxes[:, 2] <= boxes[:, 0]) | (boxes[:, 3] <= boxes[:, 1])))
    if not empty:
        return []
    return [
        Finding(
            "box_2d",
            "error" if 2 * empty > len(boxes) else "warning",
            f"all frames, {len(boxes)} cars",
            f"{empty} 2D boxes end before they begin",
            "u_min v_min u_max v_max, pixels, with u_min < u_max and v_min < v_max",
            "leave out detections that are not in the image; masks are found by these boxes",
        )
    ]
