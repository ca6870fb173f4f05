"""This module finds the pixels of a car that nearer instances hide, one instance after the other."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from directshape_torch.config import OcclusionOrder
from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import Side
from directshape_torch.scene.masks import MASK_THRESHOLD


def instances_in_front(detections: Detections, side: Side, order: OcclusionOrder = "depth") -> Tensor:
    """Whether instance i (detections first, then occluders) is in front of detection j and has a mask, (B + M, B)."""
    d, others = detections, detections.occluders
    frame, depth, bottom = d.frame_index.tolist(), d.T_cam_obj[:, 2, 3].tolist(), d.box_2d[:, 3].tolist()
    present = getattr(d, f"has_mask_{side}").tolist()
    if others is not None:
        frame, depth = frame + others.frame_index.tolist(), depth + others.depth_m.tolist()
        bottom += others.bottom_v.tolist()
        present += [True] * len(others.frame_index)

    def is_in_front(i: int, j: int) -> bool:
        if not present[i] or frame[i] != frame[j]:
            return False
        if order == "depth" and depth[i] > 0:
            return depth[i] < depth[j]
        return math.isfinite(bottom[i]) and bottom[i] > bottom[j]

    table = [[is_in_front(i, j) for j in range(len(d))] for i in range(len(frame))]
    return torch.tensor(table, dtype=torch.bool).view(len(frame), len(d))


def hidden_pixels(
    detections: Detections,
    side: Side,
    object_index: Tensor,  # (P,)
    uv: Tensor,  # (P, 2)
    order: OcclusionOrder = "depth",
) -> Tensor:  # (P,) bool
    """Whether each pixel of an object is covered by the mask of an instance in front of it."""
    sources = [detections] if detections.occluders is None else [detections, detections.occluders]
    masks = [mask for source in sources for mask in getattr(source, f"mask_{side}")]
    height, width = detections.mask_left.size_hw
    inside = (uv >= 0).all(dim=1) & (uv[:, 0] < width) & (uv[:, 1] < height)
    u, v = torch.where(inside[:, None], uv, 0).unbind(1)
    hidden = torch.zeros_like(inside)
    for mask, in_front in zip(masks, instances_in_front(detections, side, order), strict=True):
        hidden |= in_front[object_index] & (mask[v, u] > MASK_THRESHOLD)
    return hidden & inside
