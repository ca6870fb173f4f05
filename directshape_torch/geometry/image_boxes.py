"""This module measures how far boxes in images overlap, and finds the boxes around projected 3D boxes."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.geometry.box3d import BOX_EDGES, box_corners
from directshape_torch.geometry.projection import project, rays_from_pixels
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.geometry.stereo_depth import warp_to_right

_NEAR_PLANE_M = 0.5


def box_iou(
    boxes_a: NDArray[np.float64],  # (A, 4) u_min, v_min, u_max, v_max, pixels
    boxes_b: NDArray[np.float64],  # (B, 4)
) -> NDArray[np.float64]:  # (A, B)
    """Intersection over union of image boxes; boxes without an area overlap nothing.

    Examples:
        >>> box_iou(np.array([[0.0, 0.0, 2.0, 2.0]]), np.array([[1.0, 0.0, 3.0, 2.0]])).round(3)
        array([[0.333]])
    """
    a, b = boxes_a.reshape(-1, 1, 4), boxes_b.reshape(1, -1, 4)
    sides = np.minimum(a[..., 2:], b[..., 2:]) - np.maximum(a[..., :2], b[..., :2])
    intersection = np.clip(sides, 0, None).prod(axis=-1)
    area_a, area_b = (np.clip(box[..., 2:] - box[..., :2], 0, None).prod(axis=-1) for box in (a, b))
    union = area_a + area_b - intersection
    return np.asarray(np.divide(intersection, union, out=np.zeros_like(union), where=union > 0))


def project_boxes(
    T_cam_obj: Tensor,  # (B, 4, 4)
    dimensions_hwl: Tensor,  # (B, 3) metres
    camera: StereoCamera,  # of one frame
    size_hw: tuple[int, int],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:  # (B, 4), (B, 4)
    """2D boxes around 3D boxes in the left and the right image, clipped to the image; no area where out of sight."""
    left, right = box_outlines(T_cam_obj, dimensions_hwl, camera)
    return enclosing_boxes(left, size_hw), enclosing_boxes(right, size_hw)


def box_outlines(
    T_cam_obj: Tensor,  # (B, 4, 4)
    dimensions_hwl: Tensor,  # (B, 3) metres
    camera: StereoCamera,  # of one frame
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:  # (B, 24, 2), (B, 24, 2)
    """The ends of the edges of 3D boxes in the left and the right image, pixels; NaN for edges that are out of sight.

    Right pixels include the residual disparity of the rig, if it has a field. Edges are cut off 0.5 m in front of the
    camera.
    """
    points_cam = _visible_edge_ends(box_corners(T_cam_obj.double(), dimensions_hwl.double()))
    in_front = ~points_cam.isnan().any(dim=-1)
    points_cam = torch.where(in_front[..., None], points_cam, torch.ones_like(points_cam))
    K_left, K_right, T_right_cam = (x[0].double() for x in (camera.K_left, camera.K_right, camera.T_right_cam))
    uv_left = project(points_cam, K_left)
    field = camera.disparity_field
    offset = () if field is None else field.offsets(uv_left)
    right = warp_to_right(rays_from_pixels(uv_left, K_left), points_cam[..., 2], K_right, T_right_cam, *offset)
    seen = (uv_left, in_front), (right.uv_right, in_front & right.in_front)
    left, right_uv = (torch.where(valid[..., None], uv, torch.nan).cpu().numpy() for uv, valid in seen)
    return left, right_uv


def _visible_edge_ends(corners_cam: Tensor) -> Tensor:
    """Both ends of the 12 edges (B, 24, 3), moved along the edge onto the near plane; NaN for hidden edges."""
    start, end = (corners_cam[:, [edge[k] for edge in BOX_EDGES]] for k in (0, 1))

    def clipped(a: Tensor, b: Tensor) -> Tensor:
        z_a, z_b = a[..., 2:], b[..., 2:]
        share = (_NEAR_PLANE_M - z_a) / torch.where(z_b == z_a, torch.ones_like(z_a), z_b - z_a)
        crossing = a + share * (b - a)
        nothing = torch.full_like(a, float("nan"))
        return torch.where(z_a >= _NEAR_PLANE_M, a, torch.where(z_b >= _NEAR_PLANE_M, crossing, nothing))

    return torch.cat([clipped(start, end), clipped(end, start)], dim=1)


def enclosing_boxes(
    outlines: NDArray[np.float64],  # (B, P, 2) pixels, NaN where out of sight
    size_hw: tuple[int, int],
) -> NDArray[np.float64]:  # (B, 4)
    """The boxes around points, clipped to the image; no area where all of them are out of sight."""
    limit = np.array([size_hw[1] - 1.0, size_hw[0] - 1.0])
    known = np.isfinite(outlines)
    low = np.where(known, outlines, np.inf).min(axis=1).clip(0, limit)
    high = np.where(known, outlines, -np.inf).max(axis=1).clip(0, limit)
    return np.concatenate([low, high], axis=-1)
