"""The training loss: how far a refined box is from the true one, differentiable and bounded."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from directshape_torch.evaluation.rotated_iou import bev_boxes, bev_iou
from directshape_torch.geometry.box3d import box_corners, pose_from_kitti
from directshape_torch.result import RefinementResult

# Corner distance at which that part of the loss has half of its bound: cars that are lost must not decide.
HALF_DISTANCE_M = 0.5


def refined_boxes(result: RefinementResult) -> Tensor:
    """Boxes (B, 7) of a refinement, columns as in `boxes_of`, with their graph."""
    boxes = result.boxes()
    return torch.cat([boxes.location_ref, boxes.dimensions_hwl, boxes.rotation_y[:, None]], dim=1)


def box_losses(
    boxes: Tensor,  # (N, 7)
    true_boxes: Tensor,  # (N, 7)
) -> Tensor:
    """`1 - BEV IoU + d / (d + 0.5 m)` (N,), d the mean distance of the corners; front and back count as equal.

    The detectors' headings are at times turned by half a turn, which no refinement mends.
    """
    distance = torch.minimum(
        _corner_distance(boxes, true_boxes),
        _corner_distance(boxes + boxes.new_tensor([0, 0, 0, 0, 0, 0, math.pi]), true_boxes),
    )
    return 1 - bev_iou(bev_boxes(boxes), bev_boxes(true_boxes)) + distance / (distance + HALF_DISTANCE_M)


def _corner_distance(boxes: Tensor, true_boxes: Tensor) -> Tensor:
    corners, true_corners = (box_corners(pose_from_kitti(b[:, :3], b[:, 6]), b[:, 3:6]) for b in (boxes, true_boxes))
    distance: Tensor = torch.linalg.vector_norm(corners - true_corners, dim=-1)
    return distance.mean(dim=-1)
