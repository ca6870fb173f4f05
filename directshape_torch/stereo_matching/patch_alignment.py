"""Robust Gauss-Newton (Lucas and Kanade, 1981) finds patches of one image in another, for any gain and offset.

Semi-global matching is biased towards whole pixels by up to 0.2 px. A rig's bias is as large, and a direct photometric
method uses it afterwards, so it is measured photometrically here. The row is free, too: with rows off by a few tenths
of a pixel (KITTI), slanted texture would turn the row offset into disparity.
"""

from __future__ import annotations

from typing import NamedTuple, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.image.grey_levels import grey_levels
from directshape_torch.image.interpolate import bilinear_at
from directshape_torch.stereo_matching.disparity import match_disparity

_NUM_ITERATIONS = 10
_HUBER_GREY = 10.0
_LARGEST_STEP_PX = 0.5
_CONVERGED_PX = 0.02


class PatchLimits(NamedTuple):
    """`PatchLimits` say how large patches are and which alignments are reliable."""

    radius_px: int  # patches are 2 radius + 1 pixels wide
    change_px: float  # largest change from the start, in u and in v
    # largest standard deviations of u and v, for residuals of one grey level; a weaker patch says little
    sigma_px: tuple[float, float]


_OF_DISPARITY = PatchLimits(radius_px=4, change_px=1.0, sigma_px=(0.03, 0.1))


def align_patches(
    grey: Tensor,  # (H, W) grey levels 0..255
    grey_other: Tensor,  # (H, W)
    uv: Tensor,  # (P, 2) pixels
    uv_start: Tensor,  # (P, 2) pixels in the other image
    limits: PatchLimits,
    zoom: Tensor | None = None,  # (P,) size in the other image over that in the first; None for 1
) -> tuple[Tensor, Tensor]:
    """Align a patch round each pixel with the other image.

    Returns:
        Pixels (P, 2) in the other image, and (P,) bool: converged near the start, textured, inside of both images.
    """
    offsets = torch.arange(-limits.radius_px, limits.radius_px + 1, dtype=uv.dtype, device=uv.device)
    patch = torch.stack(torch.meshgrid(offsets, offsets, indexing="xy"), dim=-1).reshape(-1, 2)
    observed, _, _, inside = bilinear_at(grey, uv[:, None] + patch)
    centred = observed - observed.mean(dim=1, keepdim=True)
    zoomed = patch if zoom is None else zoom[:, None, None] * patch
    current, weight = uv_start, torch.ones_like(observed)
    for _ in range(_NUM_ITERATIONS):
        at = bilinear_at(grey_other, current[:, None] + zoomed)
        gradient, inside_other = torch.stack([at.d_u, at.d_v], dim=-1), at.inside
        step, variance, residual = _solve_displacement(at.value - observed, gradient, centred, weight)
        weight = _HUBER_GREY / residual.abs().clamp_min(_HUBER_GREY)
        step = step.clamp(-_LARGEST_STEP_PX, _LARGEST_STEP_PX)
        current = current + step
    reliable = (
        (step.abs() < _CONVERGED_PX).all(dim=1)
        & ((current - uv_start).abs() < limits.change_px).all(dim=1)
        & (variance < variance.new_tensor(limits.sigma_px) ** 2).all(dim=1)
        & (inside & inside_other).all(dim=1)
    )
    return current, reliable


def _solve_displacement(
    residual: Tensor,  # (P, N)
    J_residual_displacement: Tensor,  # (P, N, 2)
    centred: Tensor,  # (P, N)
    weight: Tensor,  # (P, N)
) -> tuple[Tensor, Tensor, Tensor]:
    """Solve for displacement, offset and gain; return the step (P, 2), its unit variance (P, 2) and new residuals."""
    J = torch.cat([J_residual_displacement, torch.ones_like(centred)[..., None], centred[..., None]], dim=-1)
    weighted = J * weight[..., None]
    # The floor keeps patches without texture solvable; they are rejected by their variance.
    H = weighted.mT @ J + 1e-3 * torch.eye(4, dtype=J.dtype, device=J.device)
    inverse = torch.linalg.inv(H)
    step = -(inverse @ (weighted.mT @ residual[..., None]))
    return step[:, :2, 0], inverse.diagonal(dim1=1, dim2=2)[:, :2], residual + (J @ step)[..., 0]


class RefinedDisparity(NamedTuple):
    """A `RefinedDisparity` holds disparities after photometric refinement."""

    disparity: Tensor  # (P,) pixels
    row_shift: Tensor  # (P,) v_left - v_right, pixels
    reliable: Tensor  # (P,) bool: converged near the start, textured, patch inside both images


class MatchedPair(NamedTuple):
    """A `MatchedPair` is a rectified pair with its semi-global disparity, from which patches are aligned."""

    grey_left: Tensor  # (H, W) grey levels 0..255
    grey_right: Tensor  # (H, W)
    matched: Tensor  # (H, W) pixels, NaN where unknown

    @classmethod
    def of(
        cls,
        image_left: NDArray[np.uint8],  # (H, W, 3) RGB
        image_right: NDArray[np.uint8],  # (H, W, 3)
    ) -> Self:
        """Match two images in float64; it raises the errors of `match_disparity`."""
        matched = torch.from_numpy(match_disparity(image_left, image_right)).double()
        images = (torch.from_numpy(np.ascontiguousarray(image)) for image in (image_left, image_right))
        left, right = (grey_levels(image.permute(2, 0, 1).double()[None] / 255)[0] for image in images)
        return cls(left, right, matched)

    def aligned(
        self,
        uv_left: Tensor,  # (P, 2) pixels
        disparity: Tensor,  # (P,) start, pixels
        row_shift: Tensor,  # (P,) start of v_left - v_right, pixels
    ) -> RefinedDisparity:
        """Align a 9 x 9 patch round each left pixel with the right image, robustly, for any gain and offset."""
        start = uv_left - torch.stack([disparity, row_shift], dim=-1)
        uv_right, reliable = align_patches(self.grey_left, self.grey_right, uv_left, start, _OF_DISPARITY)
        disparity, row_shift = (uv_left - uv_right).unbind(dim=-1)
        return RefinedDisparity(disparity, row_shift, reliable)

    def seen_at(
        self,
        uv_left: Tensor,  # (P, 2) whole pixels, float64, where a disparity is known
    ) -> Tensor:  # (Q, 4)
        """The pixels whose patches could be aligned: u, v, disparity, row shift."""
        start = self.matched[uv_left[:, 1].long(), uv_left[:, 0].long()]
        found = self.aligned(uv_left, start, torch.zeros_like(start))
        return torch.cat([uv_left, torch.stack(found[:2], dim=1)], dim=1)[found.reliable]
