"""The road as a constraint on the field: a plane at a known height, its slope and roll unknown in every frame.

With `a = -normal / height` (so that `a . x_cam = 1` on the road), inverse depth is `a . ray_cam`, hence disparity is an
affine function of the pixel: `d = f b (a_x (u - c_u) / f + a_y (v - c_v) / f + a_z)`. Pitch (a_z) and roll (a_x) are
free, so a constant in the field and its slope along u are NOT seen: any of them is a road that lies otherwise. The
known height fixes `|a|`, with it the slope along v; and everything of higher degree bends the plane, which is seen.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import torch
from torch import Tensor

from directshape_torch.geometry.camera import rays_from_pixels
from directshape_torch.geometry.disparity_field import polynomial_basis
from directshape_torch.rig.rig import Rig
from directshape_torch.rig.self_calibration import PATCH_SIGMA_PX, FieldConstraint
from directshape_torch.stereo_matching.patch_alignment import MatchedPair
from directshape_torch.stereo_matching.plane_from_points import fit_ground_plane

_SPACING_PX = 8
_BORDER_PX = 6
_DEPTH_RANGE_M = (4.0, 30.0)
_LARGEST_LATERAL_M = 8.0
# From the plane through the raw points, which is off itself by the rig's bias.
_LARGEST_DIFFERENCE_PX = 1.5
_FEWEST_PIXELS = 100
# Roads are even to about this share of the camera's height, and so is the disparity on them.
_UNEVENNESS = 0.01
# A car bounces on its springs, and its road is no plane: this much, metres, in every frame.
_HEIGHT_SIGMA_M = 0.02


@dataclass(frozen=True)
class RoadConstraint(FieldConstraint):
    """The road of one frame; own unknowns: `inverse_plane`."""

    inverse_plane: Tensor  # (3,) `a` with `a . x_cam = 1` on the road, 1/m: minus the upward normal over the height
    height_m: float  # of the camera above it

    def residuals(self, coefficients: Tensor) -> tuple[Tensor, Tensor]:
        """Disparity, predicted less measured."""
        rays_cam = rays_from_pixels(self.uv, self.rig.K_left)
        predicted, slope = self.disparity(rays_cam, self.inverse_depth(coefficients))
        basis = polynomial_basis(self.uv, self.rig.size_wh)
        sigma = (PATCH_SIGMA_PX**2 + (_UNEVENNESS * self.seen[:, 2:3]) ** 2).sqrt()
        residual = (predicted + basis @ coefficients - self.seen[:, 2])[:, None] / sigma
        return residual, (torch.cat([slope[:, None] * rays_cam, basis], dim=1) / sigma)[:, None]

    def inverse_depth(self, coefficients: Tensor) -> Tensor:
        """That of the plane."""
        return (rays_from_pixels(self.uv, self.rig.K_left) @ self.inverse_plane).clamp_min(1e-4)

    def moved(self, own_step: Tensor) -> Self:
        """Another plane."""
        return replace(self, inverse_plane=self.inverse_plane + own_step)

    def known(self) -> tuple[Tensor, Tensor]:
        """The height."""
        height = 1 / self.inverse_plane.norm()
        return (height - self.height_m) / _HEIGHT_SIGMA_M, -self.inverse_plane * height**3 / _HEIGHT_SIGMA_M


def find_road(pair: MatchedPair, rig: Rig, height_m: float) -> RoadConstraint | None:
    """Pixels 4 to 30 m ahead that lie near the dominant plane; None where no road is seen."""
    seen = pair.seen_at(_grid(pair.matched))
    rays_cam = rays_from_pixels(seen[:, :2], rig.K_left)
    plane = fit_ground_plane(rig.depth(seen[:, :2], seen[:, 2])[:, None] * rays_cam)
    if plane is None:
        return None
    inverse_plane = -plane[0] / plane[1]
    depth = 1 / (rays_cam @ inverse_plane).clamp_min(1e-3)
    near = (seen[:, 2] - rig.displacement(seen[:, :2], depth)[:, 0]).abs() < _LARGEST_DIFFERENCE_PX
    ahead = (depth > _DEPTH_RANGE_M[0]) & (depth < _DEPTH_RANGE_M[1])
    on_road = near & ahead & ((depth * rays_cam[:, 0]).abs() < _LARGEST_LATERAL_M)
    if int(on_road.sum()) < _FEWEST_PIXELS:
        return None
    return RoadConstraint(rig, seen[on_road], inverse_plane, height_m)


def _grid(matched: Tensor) -> Tensor:
    """(P, 2) every eighth pixel of the lower half that has a disparity."""
    height, width = matched.shape
    v = torch.arange(height // 2, height - _BORDER_PX, _SPACING_PX)
    u = torch.arange(_BORDER_PX, width - _BORDER_PX, _SPACING_PX)
    uv = torch.stack(torch.meshgrid(u, v, indexing="xy"), dim=-1).reshape(-1, 2)
    return uv[matched[uv[:, 1], uv[:, 0]].isfinite()].double()
