"""2D boxes: corners, not corner and size."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from directshape_torch.data_check.car_evidence import FrameEvidence
from directshape_torch.data_check.finding import Finding
from directshape_torch.geometry.box3d import pose_from_kitti
from directshape_torch.io.kitti_labels import shift_frame
from directshape_torch.io.mask_matching import box_iou, project_boxes

MIN_GAIN = 0.15


def check_box_2d(frames: Sequence[FrameEvidence]) -> list[Finding]:
    """Whether `x y width height` fits the projected 3D boxes better than `u_min v_min u_max v_max`."""
    as_corners, as_size, upside_down = [], [], 0
    for frame in frames:
        projected = _projected(frame)
        for seen, box in zip(frame.boxes.box_2d, projected, strict=True):
            other = np.array([seen[0], seen[1], seen[0] + seen[2], seen[1] + seen[3]])
            both = box_iou(box[None], np.stack([seen, other]))[0]
            as_corners.append(both[0])
            as_size.append(both[1])
            upside_down += int(seen[2] <= seen[0] or seen[3] <= seen[1])
    if not as_corners or not (upside_down or np.mean(as_size) > np.mean(as_corners) + MIN_GAIN):
        return []
    return [
        Finding(
            "box_2d",
            "error",
            f"all frames, {len(as_corners)} cars",
            f"{upside_down} 2D boxes end before they begin; projected 3D boxes overlap them by "
            f"{np.mean(as_corners):.2f}, and by {np.mean(as_size):.2f} when read as x y width height",
            "u_min v_min u_max v_max, pixels",
            "add x to the width and y to the height",
        )
    ]


def _projected(frame: FrameEvidence) -> NDArray[np.float64]:  # (N, 4)
    boxes = frame.boxes
    T_ref_obj = pose_from_kitti(torch.from_numpy(boxes.location), torch.from_numpy(boxes.rotation_y))
    T_cam_obj = shift_frame(T_ref_obj, frame.camera.t_cam_ref[0])
    return project_boxes(T_cam_obj, torch.from_numpy(boxes.hwl), frame.camera, frame.size_hw)[0]
