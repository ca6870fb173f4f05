"""This module computes errors of 3D boxes: centre, heading and IoU."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Generic, NamedTuple, TypeVar

import torch
from torch import Tensor

from directshape_torch.evaluation.rotated_iou import bev_boxes, bev_iou, iou_3d
from directshape_torch.geometry.box3d import wrap_angle
from directshape_torch.io.kitti_labels import KittiObject
from directshape_torch.numerics.checks import check_shape
from directshape_torch.numerics.full_precision import in_full_precision

Number = TypeVar("Number", Tensor, float)


class PoseErrors(NamedTuple, Generic[Number]):
    """A `PoseErrors` has the errors of N boxes against the true ones, each (N,), or of one box, each a number."""

    centre_m: Number  # distance of the centres of the boxes (not of their bottom faces), metres
    centre_bev_m: Number  # distance of the centres seen from above, along x and z
    yaw_deg: Number  # difference of heading, 0 .. 180 degrees (modulo 360)
    yaw_axis_deg: Number  # difference of heading without regard to front and back, 0 .. 90 degrees (modulo 180)
    bev_iou: Number  # IoU of the footprints
    iou_3d: Number  # IoU of the boxes
    along_m: Number  # error of the centre along the viewing ray of the true box, seen from above; positive: too far
    across_m: Number  # error across that ray; positive: to the right
    length_m: Number  # positive for a box that is too long


CarErrors = PoseErrors[float]


def errors_of(objects: Sequence[KittiObject], true: Sequence[KittiObject]) -> list[CarErrors]:
    """The errors of each object against the true object with the same index."""
    errors = pose_errors(boxes_of(objects), boxes_of(true))
    return [PoseErrors(*row) for row in torch.stack(list(errors), dim=-1).tolist()]


def boxes_of(objects: Sequence[KittiObject]) -> Tensor:
    """Boxes (N, 7) of label or result lines: x, y, z of the bottom centre, height, width, length, rotation_y.

    Examples:
        >>> boxes_of([]).shape
        torch.Size([0, 7])
    """
    rows = [(*o.location_ref, *o.hwl, o.rotation_y) for o in objects]
    return torch.tensor(rows, dtype=torch.float64).reshape(-1, 7)


@in_full_precision
def pose_errors(
    boxes: Tensor,  # (N, 7)
    true_boxes: Tensor,  # (N, 7)
) -> PoseErrors[Tensor]:
    """Errors of boxes, paired row by row with the true ones; columns as in `boxes_of`.

    Raises:
        InputError: a shape other than (N, 7), or two different N.

    Examples:
        >>> true = torch.tensor([[0.0, 1.6, 10.0, 1.5, 1.7, 4.0, 0.0]])
        >>> found = torch.tensor([[0.3, 1.6, 10.4, 1.5, 1.7, 4.0, 3.1415927]])
        >>> errors = pose_errors(found, true)
        >>> errors.centre_m, errors.yaw_deg, errors.yaw_axis_deg
        (tensor([0.5000]), tensor([180.]), tensor([0.]))
        >>> errors.along_m, errors.across_m
        (tensor([0.4000]), tensor([0.3000]))
    """
    check_shape("boxes", boxes, ("N", 7))
    check_shape("true_boxes", true_boxes, (len(boxes), 7))
    offset = _centres(boxes) - _centres(true_boxes)
    ray = true_boxes[:, [0, 2]] / true_boxes[:, [0, 2]].norm(dim=-1, keepdim=True).clamp_min(1e-9)
    yaw = wrap_angle(boxes[:, 6] - true_boxes[:, 6]).abs()
    return PoseErrors(
        centre_m=offset.norm(dim=-1),
        centre_bev_m=offset[:, [0, 2]].norm(dim=-1),
        yaw_deg=torch.rad2deg(yaw),
        yaw_axis_deg=torch.rad2deg(torch.minimum(yaw, math.pi - yaw)),
        bev_iou=bev_iou(bev_boxes(boxes), bev_boxes(true_boxes)),
        iou_3d=iou_3d(boxes, true_boxes),
        along_m=(offset[:, [0, 2]] * ray).sum(dim=-1),
        across_m=offset[:, 0] * ray[:, 1] - offset[:, 2] * ray[:, 0],
        length_m=boxes[:, 5] - true_boxes[:, 5],
    )


def _centres(boxes: Tensor) -> Tensor:
    return boxes[:, :3] - 0.5 * boxes[:, 3:4] * boxes.new_tensor([0.0, 1.0, 0.0])
