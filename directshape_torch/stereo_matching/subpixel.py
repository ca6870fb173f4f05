"""Photometric refinement of disparities: Gauss-Newton on small patches (Lucas and Kanade, 1981).

Semi-global matching leans towards whole pixels by up to 0.2 px. A rig's bias is of that size, and what uses the bias
afterwards is a direct photometric method, so it is measured photometrically here. The row is free too: with rows off by
a few tenths of a pixel (KITTI), slanted texture would turn the row offset into disparity.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.stereo_matching.patch_alignment import PatchLimits, align_patches

_LIMITS = PatchLimits(radius_px=4, change_px=1.0, sigma_px=(0.03, 0.1))


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

    Examples:
        >>> u = torch.arange(60, dtype=torch.float64)
        >>> rows = 30 * torch.cos(u[:20, None] / 2)
        >>> left, right = (100 + 50 * torch.sin((u + shift) / 3) + rows for shift in (0.0, 7.3))
        >>> refined = refine_disparity(left, right, torch.tensor([[30.0, 10.0]]).double(), u[7:8], u[:1])
        >>> round(float(refined.disparity), 1), bool(refined.reliable)
        (7.3, True)
    """
    start = torch.stack([disparity, row_shift], dim=-1)
    uv_right, reliable = align_patches(grey_left, grey_right, uv_left, uv_left - start, _LIMITS)
    disparity, row_shift = (uv_left - uv_right).unbind(dim=-1)
    return RefinedDisparity(disparity, row_shift, reliable)
