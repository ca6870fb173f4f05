"""This module finds pixels of a car that instances in front of it hide (paper, section "Occlusion Handling").

Occluders of a car are all instances of the same frame that stand in front of it and have a mask in the image: the
other detections, and `Detections.occluders` of any class. An occluder hides pixels where its probability exceeds 0.5.

Each instance has a number, and is in front of a car where its number is less than the car's. One image a frame, with
the least number of the instances that cover each pixel, therefore tells what hides every car.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from directshape_torch.config import OcclusionOrder
from directshape_torch.rows import OcclusionMap
from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import Side
from directshape_torch.scene.masks import MASK_THRESHOLD, MaskCrops


def occlusion_map(detections: Detections, side: Side, order: OcclusionOrder = "depth") -> OcclusionMap:
    """The map of what hides the B objects in one image.

    Args:
        detections: B objects and M further occluders.
        side: image whose masks are used.
        order: "depth": the instance whose origin has the smaller depth is in front; an instance of unknown depth (NaN,
            or not in front of the camera) is ordered by its box. "box_bottom": the instance with the lower bottom edge
            of the left 2D box is in front, as in the paper. Equal numbers and NaN hide nothing.

    Examples:
        >>> masks = torch.zeros(2, 40, 60)
        >>> masks[0, 10:20, 10:30], masks[1, 10:20, 20:40] = 1.0, 1.0
        >>> boxes = torch.tensor([[0.0, 1.6, 10.0, 1.5, 1.6, 4.0, 0.0], [1.0, 1.6, 20.0, 1.5, 1.6, 4.0, 0.0]])
        >>> hidden = occlusion_map(Detections.from_boxes(boxes, mask_left=masks), "left")
        >>> hidden.at(torch.tensor([0, 1, 1]), torch.tensor([[25, 15], [25, 15], [35, 15]]))
        tensor([False,  True, False])
    """
    frame, numbers, limits = _instances(detections, order)
    masks = _masks(detections, side)
    boxes, crops = masks.boxes.tolist(), [masks.crop(row) for row in range(len(masks))]
    shown = [box for box in boxes if box[2] > box[0]] or [(0, 0, 0, 0)]
    (left, top), (right, bottom) = (
        [of(edges) for edges in zip(*(box[part] for box in shown), strict=True)]
        for of, part in ((min, slice(0, 2)), (max, slice(2, 4)))
    )
    width, height, frames = right - left, bottom - top, frame.tolist()
    num_frames = max(frames, default=-1) + 1
    # There is at least one entry, because pixels outside of all masks look up entry 0.
    covering = numbers.new_full((max(1, num_frames * height * width), 2), torch.inf)
    images = covering[: num_frames * height * width].view(num_frames, height, width, 2)
    instances = zip(numbers.tolist(), frames, boxes, crops, strict=True)
    # Instances are painted from back to front, so that the foremost stays. Each has a number of one kind, or none.
    for of_kinds, at, (u0, v0, u1, v1), crop in sorted(instances, key=lambda instance: instance[0], reverse=True):
        covers = crop > MASK_THRESHOLD
        for kind, number in enumerate(of_kinds):
            if number < math.inf:
                images[at, v0 - top : v1 - top, u0 - left : u1 - left, kind].masked_fill_(covers, number)
    first = detections.frame_index * (height * width) - top * width - left
    crop = first.new_tensor([left, top, right, bottom, 0, width]).repeat(len(detections), 1)
    crop[:, 4] = first
    return OcclusionMap(crop, limits, covering)


def _instances(detections: Detections, order: str) -> tuple[Tensor, Tensor, Tensor]:
    """Frames and numbers (B + M, 2) of all instances, and limits (B, 2) below which they are in front of detections."""
    d, others = detections, detections.occluders
    frame, depth_m, bottom_v = d.frame_index, d.T_cam_obj[:, 2, 3], d.box_2d[:, 3]
    limits = torch.stack([torch.where(depth_m > 0, depth_m, -torch.inf), -bottom_v], dim=1)
    if others is not None:
        frame = torch.cat([frame, others.frame_index])
        depth_m = torch.cat([depth_m, others.depth_m.to(depth_m)])
        bottom_v = torch.cat([bottom_v, others.bottom_v.to(bottom_v)])
    # The order of instances has no derivative.
    limits, depth_m, bottom_v = limits.detach(), depth_m.detach(), bottom_v.detach()
    by_depth = (depth_m > 0) & (order == "depth")  # False for NaN
    numbers = torch.where(
        torch.stack([by_depth, ~by_depth & bottom_v.isfinite()], dim=1),
        torch.stack([depth_m, -bottom_v], dim=1),
        torch.inf,
    )
    return frame, numbers, limits


def _masks(detections: Detections, side: Side) -> MaskCrops:
    """The masks of all instances."""
    own, others = (detections.mask_left, detections.mask_right)[side == "right"], detections.occluders
    return own if others is None else MaskCrops.joined([own, (others.mask_left, others.mask_right)[side == "right"]])
