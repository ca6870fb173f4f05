"""How far a 3D box is from the true one: centre, heading, overlap."""

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

Number = TypeVar("Number", Tensor, float)


class PoseErrors(NamedTuple, Generic[Number]):
    """Errors of N boxes against the true ones, each (N,); or of one box, each a number.

    Attributes:
        centre_m: distance of the centres of the boxes (not of their bottom faces), metres.
        centre_bev_m: the same seen from above, along x and z alone.
        yaw_deg: difference of heading, 0 .. 180 degrees (modulo 360).
        yaw_axis_deg: the same without regard to front and back, 0 .. 90 degrees (modulo 180).
        bev_iou: overlap of the footprints.
        iou_3d: overlap of the boxes.
        along_m, across_m: of the centre seen from above, along the viewing ray of the true box (above 0: too far) and
            across it (above 0: to the right).
        length_m: above 0 where a box is too long.
    """

    centre_m: Number
    centre_bev_m: Number
    yaw_deg: Number
    yaw_axis_deg: Number
    bev_iou: Number
    iou_3d: Number
    along_m: Number
    across_m: Number
    length_m: Number


CarErrors = PoseErrors[float]


def car_errors(errors: PoseErrors[Tensor]) -> list[CarErrors]:
    """Those of each box."""
    return [PoseErrors(*row) for row in torch.stack(list(errors), dim=-1).tolist()]


def boxes_of(objects: Sequence[KittiObject], dtype: torch.dtype = torch.float64) -> Tensor:
    """Boxes (N, 7) of label or result lines: x, y, z of the bottom centre, height, width, length, rotation_y.

    Examples:
        >>> boxes_of([]).shape
        torch.Size([0, 7])
    """
    rows = [(*o.location_ref, *o.hwl, o.rotation_y) for o in objects]
    return torch.tensor(rows, dtype=dtype).reshape(-1, 7)


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
    offset = box_centres(boxes) - box_centres(true_boxes)
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


def box_centres(boxes: Tensor) -> Tensor:
    """Centres (*, 3) of boxes (*, 7) whose place is that of their bottom face; y points down.

    Examples:
        >>> box_centres(torch.tensor([[0.0, 1.6, 10.0, 1.5, 1.7, 4.0, 0.0]]))
        tensor([[ 0.0000,  0.8500, 10.0000]])
    """
    up = torch.zeros_like(boxes[..., :3])
    up[..., 1] = 0.5 * boxes[..., 3]
    return boxes[..., :3] - up
