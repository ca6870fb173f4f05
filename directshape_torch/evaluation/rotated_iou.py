"""This module computes IoU of rotated rectangles and of KITTI's upright 3D boxes, exactly and without tolerances.

The common area of two convex shapes is found without clipping polygons. The outline of one shape, clamped into the
other, still winds once around every common point and around no other point inside, because a point and its clamped
position are never on different sides of an inner point. A rectangle is clamped in its own frame by `clamp`, and a
clamped edge is a polyline with at most four breaks, so the area is one shoelace sum over 4 edges with 5 pieces each.
"""

from __future__ import annotations

import torch
from torch import Tensor

from directshape_torch.numerics.checks import check_shape
from directshape_torch.numerics.full_precision import in_full_precision

_BEV_LAYOUT = "columns are x, z, length, width, rotation_y"
_BOX_LAYOUT = "columns are x, y, z (bottom centre), height, width, length, rotation_y"


@in_full_precision
def bev_boxes(boxes: Tensor) -> Tensor:
    """Footprints (*, 5) x, z, length, width, rotation_y of KITTI boxes (*, 7) x, y, z, height, width, length, yaw.

    Examples:
        >>> bev_boxes(torch.tensor([[1.0, 1.6, 20.0, 1.5, 1.7, 4.0, 0.0]]))
        tensor([[ 1.0000, 20.0000,  4.0000,  1.7000,  0.0000]])
    """
    return boxes[..., [0, 2, 5, 4, 6]]


@in_full_precision
def bev_iou(
    boxes_a: Tensor,  # (N, 5)
    boxes_b: Tensor,  # (N, 5)
) -> Tensor:
    """Intersection over union (N,) of pairs of footprints: x, z, length, width in metres, rotation_y in radians.

    `rotation_y` is about the y axis, which points down (KITTI): the corner (dx, dz) of the box is at (c dx + s dz, -s
    dx + c dz). A pair whose areas are both zero has IoU 0.

    Raises:
        InputError: a shape other than (N, 5), or two different N.

    Examples:
        >>> a = torch.tensor([[0.0, 10.0, 4.0, 2.0, 0.0]])
        >>> bev_iou(a, a + torch.tensor([2.0, 0.0, 0.0, 0.0, 0.0]))
        tensor([0.3333])
    """
    check_shape("boxes_a", boxes_a, ("N", 5), _BEV_LAYOUT)
    check_shape("boxes_b", boxes_b, (len(boxes_a), 5), _BEV_LAYOUT)
    return _ratio(_intersection_area(boxes_a, boxes_b), _area(boxes_a), _area(boxes_b))


@in_full_precision
def iou_3d(
    boxes_a: Tensor,  # (N, 7)
    boxes_b: Tensor,  # (N, 7)
) -> Tensor:
    """Intersection over union (N,) of pairs of upright boxes: x, y, z of the bottom centre, height, width, length, yaw.

    The y axis points down, so a box reaches from y - height to y.

    Raises:
        InputError: a shape other than (N, 7), or two different N.

    Examples:
        >>> a = torch.tensor([[0.0, 1.6, 10.0, 1.5, 2.0, 4.0, 0.3]])
        >>> iou_3d(a, a + torch.tensor([0.0, 0.75, 0.0, 0.0, 0.0, 0.0, 0.0]))
        tensor([0.3333])
    """
    check_shape("boxes_a", boxes_a, ("N", 7), _BOX_LAYOUT)
    check_shape("boxes_b", boxes_b, (len(boxes_a), 7), _BOX_LAYOUT)
    footprints = bev_boxes(boxes_a), bev_boxes(boxes_b)
    height_a, height_b = boxes_a[:, 3].clamp_min(0), boxes_b[:, 3].clamp_min(0)
    bottom = torch.minimum(boxes_a[:, 1], boxes_b[:, 1])
    top = torch.maximum(boxes_a[:, 1] - height_a, boxes_b[:, 1] - height_b)
    shared = _intersection_area(*footprints) * (bottom - top).clamp_min(0)
    return _ratio(shared, _area(footprints[0]) * height_a, _area(footprints[1]) * height_b)


def _area(footprint: Tensor) -> Tensor:
    return footprint[..., 2].clamp_min(0) * footprint[..., 3].clamp_min(0)


def _ratio(intersection: Tensor, size_a: Tensor, size_b: Tensor) -> Tensor:
    """Intersection over union, or 0 if both sets are empty."""
    intersection = torch.minimum(intersection.clamp_min(0), torch.minimum(size_a, size_b))
    union = size_a + size_b - intersection
    empty = union <= 0
    return torch.where(empty, torch.zeros_like(union), intersection / torch.where(empty, torch.ones_like(union), union))


def _intersection_area(
    a: Tensor,  # (*, 5)
    b: Tensor,  # (*, 5), broadcasts with a
) -> Tensor:
    """Common area (*,) of two footprints, from the outline of a clamped into b."""
    half_b = 0.5 * b[..., 2:4].clamp_min(0)
    start = _corners_in_frame(a, b)  # (*, 4, 2)
    outline = _clamped_edges(start, start.roll(-1, dims=-2), half_b)  # (*, 4 edges, 6 points, 2)
    x, y = outline.flatten(-3, -2).unbind(-1)
    return 0.5 * (x * y.roll(-1, dims=-1) - y * x.roll(-1, dims=-1)).sum(dim=-1).abs()


def _corners_in_frame(a: Tensor, b: Tensor) -> Tensor:
    """Corners (*, 4, 2) of footprint a in the frame of footprint b: along its length and along its width."""
    offset = a[..., :2] - b[..., :2]
    cos_b, sin_b = torch.cos(b[..., 4]), torch.sin(b[..., 4])
    centre_x = cos_b * offset[..., 0] - sin_b * offset[..., 1]
    centre_y = sin_b * offset[..., 0] + cos_b * offset[..., 1]
    # A single rotation by the difference keeps boxes of equal heading exactly parallel.
    turn = a[..., 4] - b[..., 4]
    cosine, sine = torch.cos(turn)[..., None], torch.sin(turn)[..., None]
    half = 0.5 * a[..., 2:4].clamp_min(0)
    dx = half[..., :1] * a.new_tensor([1.0, -1.0, -1.0, 1.0])
    dy = half[..., 1:] * a.new_tensor([1.0, 1.0, -1.0, -1.0])
    return torch.stack(
        [centre_x[..., None] + cosine * dx + sine * dy, centre_y[..., None] - sine * dx + cosine * dy], dim=-1
    )


def _clamped_edges(
    start: Tensor,  # (*, E, 2)
    end: Tensor,  # (*, E, 2)
    half: Tensor,  # (*, 2) half sizes of the rectangle about the origin
) -> Tensor:
    """Each edge clamped into the rectangle, as a polyline (*, E, 6, 2) with its breaks in order."""
    half = half[..., None, None, :]  # (*, 1, 1, 2)
    direction = end - start
    parallel = direction == 0
    sides = torch.cat([-half, half], dim=-2)  # (*, 1, 2, 2)
    # An edge parallel to a side has no break there, so any parameter may be used for it.
    breaks = (sides - start[..., None, :]) / torch.where(parallel, torch.ones_like(direction), direction)[..., None, :]
    breaks = breaks.clamp(0, 1).flatten(-2).sort(dim=-1).values  # (*, E, 4)
    zero, one = torch.zeros_like(breaks[..., :1]), torch.ones_like(breaks[..., :1])
    t = torch.cat([zero, breaks, one], dim=-1)[..., None]  # (*, E, 6, 1)
    # Both ends are taken unchanged, because start + 1 * direction may differ from `end` in floating point.
    points = torch.where(t == 1, end[..., None, :], start[..., None, :] + t * direction[..., None, :])
    return torch.minimum(torch.maximum(points, -half), half)
