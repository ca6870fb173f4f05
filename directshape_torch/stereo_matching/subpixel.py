"""Photometric refinement of disparities: Gauss-Newton on small patches (Lucas and Kanade, 1981).

Semi-global matching leans towards whole pixels by up to 0.2 px. A rig's bias is of that size, and what uses the bias
afterwards is a direct photometric method, so it is measured photometrically here. The row is free too: with rows off by
a few tenths of a pixel (KITTI), slanted texture would turn the row offset into disparity.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.image.interpolate import bilinear_with_gradient

_RADIUS_PX = 4
_NUM_ITERATIONS = 10
_HUBER_GREY = 10.0
_LARGEST_STEP_PX = 0.5
_LARGEST_CHANGE_PX = 1.0
_CONVERGED_PX = 0.02
# Standard deviation of the disparity for residuals of one grey level; a weaker patch says little.
_LARGEST_SIGMA_PX = 0.03
_LARGEST_ROW_SIGMA_PX = 0.1


class RefinedDisparity(NamedTuple):
    """Disparities after photometric refinement."""

    disparity: Tensor  # (P,) pixels
    row_shift: Tensor  # (P,) v_left - v_right, pixels
    reliable: Tensor  # (P,) bool: converged near the start, textured, patch inside both images


def refine_disparity(
    grey_left: Tensor,  # (H, W) grey levels 0..255
    grey_right: Tensor,  # (H, W)
    uv_left: Tensor,  # (P, 2) pixels
    disparity: Tensor,  # (P,) start, pixels
    row_shift: Tensor,  # (P,) start of v_left - v_right, pixels
) -> RefinedDisparity:
    """Align a 9 x 9 patch round each left pixel with the right image, robustly, free of gain and offset.

    Example:
        >>> u = torch.arange(60, dtype=torch.float64)
        >>> rows = 30 * torch.cos(u[:20, None] / 2)
        >>> left, right = (100 + 50 * torch.sin((u + shift) / 3) + rows for shift in (0.0, 7.3))
        >>> refined = refine_disparity(left, right, torch.tensor([[30.0, 10.0]]).double(), u[7:8], u[:1])
        >>> round(float(refined.disparity), 1), bool(refined.reliable)
        (7.3, True)
    """
    offsets = torch.arange(-_RADIUS_PX, _RADIUS_PX + 1, dtype=uv_left.dtype, device=uv_left.device)
    patch = torch.stack(torch.meshgrid(offsets, offsets, indexing="xy"), dim=-1).reshape(-1, 2)
    uv = uv_left[:, None] + patch
    frame = torch.zeros(len(uv), 1, dtype=torch.long, device=uv.device)
    observed, _, inside_left = bilinear_with_gradient(grey_left[None], frame, uv)
    centred = observed - observed.mean(dim=1, keepdim=True)
    start = torch.stack([disparity, row_shift], dim=-1)
    current, weight = start, torch.ones_like(observed)
    for _ in range(_NUM_ITERATIONS):
        predicted, gradient, inside_right = bilinear_with_gradient(grey_right[None], frame, uv - current[:, None])
        step, variance, residual = solve_displacement(predicted - observed, -gradient, centred, weight)
        weight = _HUBER_GREY / residual.abs().clamp_min(_HUBER_GREY)
        step = step.clamp(-_LARGEST_STEP_PX, _LARGEST_STEP_PX)
        current = current + step
    reliable = (
        (step.abs() < _CONVERGED_PX).all(dim=1)
        & ((current - start).abs() < _LARGEST_CHANGE_PX).all(dim=1)
        & (variance[:, 0] < _LARGEST_SIGMA_PX**2)
        & (variance[:, 1] < _LARGEST_ROW_SIGMA_PX**2)
        & (inside_left & inside_right).all(dim=1)
    )
    return RefinedDisparity(current[:, 0], current[:, 1], reliable)


def solve_displacement(
    residual: Tensor,  # (P, N)
    J_residual_displacement: Tensor,  # (P, N, 2)
    centred: Tensor,  # (P, N)
    weight: Tensor,  # (P, N)
) -> tuple[Tensor, Tensor, Tensor]:
    """Least squares for displacement, offset and gain: step (P, 2), its unit variance (P, 2), residual after it."""
    J = torch.cat([J_residual_displacement, torch.ones_like(centred)[..., None], centred[..., None]], dim=-1)
    weighted = J * weight[..., None]
    # The floor keeps patches without texture solvable; they are rejected by their variance.
    H = weighted.mT @ J + 1e-3 * torch.eye(4, dtype=J.dtype, device=J.device)
    inverse = torch.linalg.inv(H)
    step = -(inverse @ (weighted.mT @ residual[..., None]))
    return step[:, :2, 0], inverse.diagonal(dim1=1, dim2=2)[:, :2], residual + (J @ step)[..., 0]
