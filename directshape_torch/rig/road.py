"""The road as a constraint on the field: a plane at a known height, its slope and roll unknown in every frame.

With `a = -normal / height` (so that `a . x_cam = 1` on the road), inverse depth is `a . ray_cam`, hence disparity is an
affine function of the pixel: `d = f b (a_x (u - c_u) / f + a_y (v - c_v) / f + a_z)`. Pitch (a_z) and roll (a_x) are
free, so a constant in the field and its slope along u are NOT seen: any of them is a road that lies otherwise. The
known height fixes `|a|`, with it the slope along v; and everything of higher degree bends the plane, which is seen.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.geometry.camera import rays_from_pixels
from directshape_torch.geometry.disparity_field import polynomial_basis
from directshape_torch.geometry.projection import depth_from_disparity, disparity_of_depth
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.rig.disparity_observations import DisparityObservations, matched_pixels
from directshape_torch.rig.field_constraint import (
    PATCH_SIGMA_PX,
    Linearisation,
    disparity_slope,
    information_share,
    tukey_weight,
)
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


# Roads are even to about this share of the camera's height, and so is the disparity on them.
_UNEVENNESS = 0.01
# A car bounces on its springs, and its road is no plane: this much, metres, in every frame.
_HEIGHT_SIGMA_M = 0.02


@dataclass(frozen=True)
class RoadConstraint:
    """The road of one frame; own unknowns: `inverse_plane` (3,)."""

    pixels: RoadPixels
    camera: StereoCamera
    size_wh: tuple[int, int]
    height_m: float
    inverse_plane: Tensor
    degrees_of_freedom: int = 1

    @classmethod
    def of(cls, pixels: RoadPixels, camera: StereoCamera, size_wh: tuple[int, int], height_m: float) -> RoadConstraint:
        """With the plane found in the raw points as start."""
        return cls(pixels, camera, size_wh, height_m, pixels.inverse_plane)

    def linearise(self, coefficients: Tensor, scale: float) -> Linearisation:
        """See `FieldConstraint`."""
        predicted, _, J_disparity_plane = self._predict()
        basis = polynomial_basis(self.pixels.uv_left, self.size_wh)
        sigma = self._sigma()
        residual = (predicted[:, 0] + basis @ coefficients - self.pixels.disparity) / sigma
        J = torch.cat([J_disparity_plane, basis], dim=1) / sigma[:, None]
        weight = tukey_weight(residual, scale)
        share = information_share(weight, scale)
        H = share * J.T @ (weight[:, None] * J)
        g = share * J.T @ (weight * residual)
        height = 1 / self.inverse_plane.norm()
        J_height = torch.zeros_like(g)
        J_height[:3] = -self.inverse_plane * height**3 / _HEIGHT_SIGMA_M
        height_residual = (height - self.height_m) / _HEIGHT_SIGMA_M
        return Linearisation(H + torch.outer(J_height, J_height), g + J_height * height_residual, residual.abs())

    def moved(self, own_step: Tensor) -> Self:
        """See `FieldConstraint`."""
        return replace(self, inverse_plane=self.inverse_plane + own_step)

    def observations(self, coefficients: Tensor, scale: float) -> DisparityObservations:
        """See `FieldConstraint`."""
        predicted, depth, _ = self._predict()
        bias = self.pixels.disparity - predicted[:, 0]
        basis = polynomial_basis(self.pixels.uv_left, self.size_wh)
        kept = tukey_weight((bias - basis @ coefficients) / self._sigma(), scale) > 0
        vertical = predicted[:, 1] - self.pixels.row_shift
        return DisparityObservations(self.pixels.uv_left[kept], bias[kept], vertical[kept], depth[kept])

    def _predict(self) -> tuple[Tensor, Tensor, Tensor]:
        """Displacement (P, 2), depth (P,), J_disparity_plane (P, 3)."""
        K_left, K_right, T_right_cam = (
            t[0].double() for t in (self.camera.K_left, self.camera.K_right, self.camera.T_right_cam)
        )
        rays_cam = rays_from_pixels(self.pixels.uv_left, K_left)
        inverse_depth = (rays_cam @ self.inverse_plane).clamp_min(1e-4)
        displacement = disparity_of_depth(self.pixels.uv_left, 1 / inverse_depth, K_left, K_right, T_right_cam)
        slope = disparity_slope(self.pixels.uv_left, inverse_depth, K_left, K_right, T_right_cam)
        return displacement, 1 / inverse_depth, slope[:, None] * rays_cam

    def _sigma(self) -> Tensor:
        return (PATCH_SIGMA_PX**2 + (_UNEVENNESS * self.pixels.disparity) ** 2).sqrt()
