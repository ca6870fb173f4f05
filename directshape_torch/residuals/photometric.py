"""Photometric residual from the left to the right image (paper, E_photo), and the depth of the surface under a pixel.

Depth is the z coordinate in the left camera. Its derivative by the state is exact: with `slope = grad . ray_obj` at
the surface, `d depth / d sdf = -1 / slope`; the paper's `-1 / cos(theta)` assumes |grad| = 1 and depth along the ray.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.geometry.short_axes import all_along, length
from directshape_torch.geometry.stereo import warp_to_right
from directshape_torch.image.interpolate import bilinear_with_gradient
from directshape_torch.residuals.state_chain import sdf_state_jacobian
from directshape_torch.shape.shape_prior import SdfDerivatives

# DSO's pattern of 8 neighbourhood pixels (Engel et al., Direct Sparse Odometry, fig. 4), as (du, dv).
DSO_PATTERN: tuple[tuple[int, int], ...] = ((0, -2), (-1, -1), (1, -1), (-2, 0), (0, 0), (2, 0), (-1, 1), (0, 2))


class SurfaceDepth(NamedTuple):
    """Depth of the first surface point of each ray and its derivative."""

    J_depth_state: Tensor  # (P, 6 + K), zero where grazing
    grazing: Tensor  # (P,) bool: the ray is too close to the tangent plane for the depth to mean anything


def surface_slope(gradient: Tensor, direction_obj: Tensor, min_cosine: float) -> tuple[Tensor, Tensor]:
    """`slope = grad . ray_obj` (P,) and where it is grazing: `|slope| <= min_cosine |grad| |ray|`."""
    slope = (gradient * direction_obj).sum(-1)
    grazing = slope.abs() <= min_cosine * length(gradient, dim=-1) * length(direction_obj, dim=-1)
    return slope, grazing


def depth_state_jacobian(
    points_obj: Tensor,  # (P, 3) surface points
    at: SdfDerivatives,
    direction_obj: Tensor,  # (P, 3) R_obj_cam K^-1 [u, v, 1]
    min_cosine: float,
) -> SurfaceDepth:
    """`J_depth_state = -1 / (grad . ray_obj) [grad, X x grad, basis]`, by the implicit function theorem.

    Example:
        >>> at = SdfDerivatives(torch.zeros(1), torch.tensor([[0.0, 0.0, -0.8]]), torch.zeros(1, 0))
        >>> depth_state_jacobian(torch.zeros(1, 3), at, torch.tensor([[0.0, 0.0, 1.0]]), 0.1).J_depth_state[0, 2]
        tensor(-1.)
    """
    slope, grazing = surface_slope(at.gradient, direction_obj, min_cosine)
    safe_slope = torch.where(grazing, torch.ones_like(slope), slope)
    d_depth_sdf = torch.where(grazing, torch.zeros_like(slope), -1 / safe_slope)
    return SurfaceDepth(d_depth_sdf[..., None] * sdf_state_jacobian(points_obj, at), grazing)


class PhotometricResidual(NamedTuple):
    """Residuals of P pixels and their N neighbourhood pixels, with the derivative by the one depth of each pixel."""

    residual: Tensor  # (P, N) right minus left, grey levels
    J_residual_depth: Tensor  # (P, N) grey levels per metre
    inside: Tensor  # (P,) bool: every neighbourhood pixel lands in the right image
    uv_right: Tensor  # (P, 2) where the pixel itself lands


def photometric_residual(
    image_right: Tensor,  # (F, H, W) grey levels, at some pyramid level
    sizes: Tensor,  # (F, 2) height, width at that level
    level_scale: float,  # 1, 1/2, 1/4, ...: pixels of the level per full-resolution pixel
    frame_index: Tensor,  # (P,)
    intensity_left: Tensor,  # (P, N) grey levels, already brought to the right image's brightness
    rays_left: Tensor,  # (P, N, 3) K^-1 [u, v, 1] of the neighbourhood pixels
    depth: Tensor,  # (P,)
    K_right: Tensor,  # (P, 3, 3)
    T_right_cam: Tensor,  # (P, 4, 4)
    bias_px: Tensor | None,  # (P,)
    vertical_px: Tensor | None,  # (P,)
    centre: int,  # which neighbourhood pixel is the pixel itself
) -> PhotometricResidual:
    """`r = I_r(warp(p~, d_p)) - I_l(p~)` for the neighbourhood, all warped with the centre's depth (paper, r_photo).

    Chain: `J_residual_depth = grad I_r . J_pixel_depth`, with the exact derivative of the bilinear lookup.
    """
    offsets = (x if x is None else x[:, None] for x in (bias_px, vertical_px))
    warped = warp_to_right(rays_left, depth[:, None], K_right[:, None], T_right_cam[:, None], *offsets)
    uv_level = (warped.uv_right + 0.5) * level_scale - 0.5
    intensity, gradient, in_image = bilinear_with_gradient(image_right, frame_index[:, None], uv_level, sizes)
    J_residual_depth = (gradient * warped.J_pixel_depth).sum(-1) * level_scale
    inside = all_along(in_image & warped.in_front, dim=1)
    return PhotometricResidual(intensity - intensity_left, J_residual_depth, inside, warped.uv_right[:, centre])
