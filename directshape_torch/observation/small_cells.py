"""The small cells of regions, of which each gives at most one pixel."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from directshape_torch.config import SamplingConfig


class CellPixels(NamedTuple):
    """One for each small cell of all regions, in order; numbers mean nothing where there is none."""

    object_index: Tensor  # (N,)
    u: Tensor  # (N,)
    v: Tensor  # (N,)
    exists: Tensor  # (N,) bool


def small_cell_side(
    regions: Tensor,  # (B, 4)
    settings: SamplingConfig,
) -> Tensor:
    """Side of the cells of each region, (B,) float64, pixels; at least one pixel."""
    areas = ((regions[:, 3] - regions[:, 1]) * (regions[:, 2] - regions[:, 0])).double()
    wanted = (settings.density * areas).clamp(settings.min_pixels, settings.max_pixels)
    return (areas / wanted).sqrt().clamp(min=1.0)
