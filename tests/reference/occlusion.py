"""Which pixels of a car nearer instances hide, one instance after the other."""

from __future__ import annotations

import torch
from torch import Tensor

from directshape_torch.observation.extents import MASK_THRESHOLD
from directshape_torch.observation.occlusion import OcclusionOrder, Side, instances_in_front
from directshape_torch.scene import Detections


def hidden_pixels(
    detections: Detections,
    side: Side,
    object_index: Tensor,  # (P,)
    uv: Tensor,  # (P, 2)
    order: OcclusionOrder = "depth",
) -> Tensor:  # (P,) bool
    """Whether each pixel of an object is covered by the mask of an instance in front of it."""
    sources = [detections] if detections.occluders is None else [detections, detections.occluders]
    masks = [mask for source in sources for mask in getattr(source, f"mask_{side}").unbind()]
    height, width = detections.mask_left.shape[1:]
    inside = (uv >= 0).all(dim=1) & (uv[:, 0] < width) & (uv[:, 1] < height)
    u, v = torch.where(inside[:, None], uv, 0).unbind(1)
    hidden = torch.zeros_like(inside)
    for mask, in_front in zip(masks, instances_in_front(detections, side, order), strict=True):
        hidden |= in_front[object_index] & (mask[v, u] > MASK_THRESHOLD)
    return hidden & inside
