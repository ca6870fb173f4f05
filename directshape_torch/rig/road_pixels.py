"""Pixels of the road in one stereo frame, with their disparity."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.geometry.camera import depth_from_disparity, disparity_of_depth, rays_from_pixels
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.rig.motion_tracks import matched_pixels
from directshape_torch.stereo_matching.plane_from_points import fit_ground_plane

_SPACING_PX = 8
_BORDER_PX = 6
_DEPTH_RANGE_M = (4.0, 30.0)
_LARGEST_LATERAL_M = 8.0
# From the plane through the raw points, which is off itself by the rig's bias.
_LARGEST_DIFFERENCE_PX = 1.5
_FEWEST_PIXELS = 100


@dataclass(frozen=True)
class RoadPixels:
    """Pixels near the road's plane.

    Attributes:
        uv_left: (P, 2) pixels, float64.
        disparity, row_shift: (P,) measured, pixels.
        inverse_plane: (3,) `a` with `a . x_cam = 1` on the road, 1/m: minus the upward normal over the height.
    """

    uv_left: Tensor
    disparity: Tensor
    row_shift: Tensor
    inverse_plane: Tensor


def find_road_pixels(
    image_left: NDArray[np.uint8],  # (H, W, 3) RGB
    image_right: NDArray[np.uint8],  # (H, W, 3)
    camera: StereoCamera,  # one frame; its disparity field is not used
    matched: Tensor,  # (H, W) semi-global disparity, pixels
) -> RoadPixels | None:
    """Pixels 4 to 30 m ahead that lie near the dominant plane; None where no road is seen."""
    K_left, K_right, T_right_cam = (t[0].double() for t in (camera.K_left, camera.K_right, camera.T_right_cam))
    uv, disparity, row_shift = matched_pixels(image_left, image_right, _grid(matched), matched)
    rays_cam = rays_from_pixels(uv, K_left)
    points_cam = depth_from_disparity(uv, disparity, K_left, K_right, T_right_cam)[:, None] * rays_cam
    plane = fit_ground_plane(points_cam)
    if plane is None:
        return None
    inverse_plane = -plane[0] / plane[1]
    expected_depth = 1 / (rays_cam @ inverse_plane).clamp_min(1e-3)
    expected = disparity_of_depth(uv, expected_depth, K_left, K_right, T_right_cam)[:, 0]
    near = (disparity - expected).abs() < _LARGEST_DIFFERENCE_PX
    ahead = (expected_depth > _DEPTH_RANGE_M[0]) & (expected_depth < _DEPTH_RANGE_M[1])
    on_road = near & ahead & ((expected_depth * rays_cam[:, 0]).abs() < _LARGEST_LATERAL_M)
    if int(on_road.sum()) < _FEWEST_PIXELS:
        return None
    return RoadPixels(uv[on_road], disparity[on_road], row_shift[on_road], inverse_plane)


def _grid(matched: Tensor) -> Tensor:
    """(P, 2) every eighth pixel of the lower half that has a disparity."""
    height, width = matched.shape
    v = torch.arange(height // 2, height - _BORDER_PX, _SPACING_PX)
    u = torch.arange(_BORDER_PX, width - _BORDER_PX, _SPACING_PX)
    uv = torch.stack(torch.meshgrid(u, v, indexing="xy"), dim=-1).reshape(-1, 2)
    return uv[matched[uv[:, 1], uv[:, 0]].isfinite()].double()
