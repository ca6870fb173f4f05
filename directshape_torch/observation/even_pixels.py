"""The mode "uniform": the pixel nearest to the middle of each small cell, without a look at any other.

How near a pixel is to the centre of its cell is a sum over both axes, so the nearest row and the nearest column are
found by themselves: of a region a few numbers a row and a column of cells.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.config import SamplingConfig
from directshape_torch.observation.small_cells import CellPixels, small_cell_side

# Pixels: what rounding makes of distances that are equal.
_ROUNDING_PX = 1e-6


def even_pixels(
    regions: Tensor,  # (B, 4)
    settings: SamplingConfig,
) -> CellPixels:
    """The pixel nearest to the middle of each small cell; of those that differ by rounding the first, row-major.

    Args:
        regions: (B, 4) integer (u0, v0, u1, v1), half open.
        settings: density; its mode is not asked for.

    Example:
        >>> chosen = even_pixels(torch.tensor([[5, 2, 11, 6]]), SamplingConfig(min_pixels=6, max_pixels=6))
        >>> chosen.u.tolist(), chosen.v.tolist()
        ([5, 7, 9, 5, 7, 9], [2, 2, 2, 4, 4, 4])
    """
    side = small_cell_side(regions, settings)
    lengths = regions[:, 2:] - regions[:, :2]
    cells = (lengths / side[:, None]).ceil().long()
    columns, count = cells[:, 0], cells[:, 0] * cells[:, 1]
    on_axes, total = torch.stack([cells.sum(), count.sum()]).tolist()
    # Columns of cells of all regions, then rows of cells of all regions.
    line = _Runs.of(cells.mT.flatten(), on_axes)
    sides, edges, ends = (
        x.index_select(0, line.run) for x in (side.repeat(2), regions[:, :2].mT.flatten(), lengths.mT.flatten())
    )
    nearest, exists = _nearest(line.place, sides, ends)
    nearest = nearest + edges
    cell = _Runs.of(count, total)
    in_row = columns.index_select(0, cell.run)
    row = torch.div(cell.place, in_row, rounding_mode="floor")
    of_column = line.first.index_select(0, cell.run) + cell.place - row * in_row
    of_row = line.first.index_select(0, cell.run + len(regions)) + row
    u, v = nearest.index_select(0, of_column), nearest.index_select(0, of_row)
    return CellPixels(cell.run, u, v, exists.index_select(0, of_column) & exists.index_select(0, of_row))


class _Runs(NamedTuple):
    """Entries of several runs one after the other."""

    run: Tensor  # (N,) of each entry
    place: Tensor  # (N,) within its run
    first: Tensor  # (R,) number of the first entry of each run

    @classmethod
    def of(cls, lengths: Tensor, total: int) -> _Runs:
        """Of so many entries (R,) each, in all `total`."""
        number = torch.arange(len(lengths), device=lengths.device)
        run = number.repeat_interleave(lengths, output_size=total)
        first = lengths.cumsum(0) - lengths
        return cls(run, torch.arange(total, device=lengths.device) - first.index_select(0, run), first)


def _nearest(
    cell: Tensor,  # (N,) number on its axis
    side: Tensor,  # (N,) float64, pixels, at least one
    length: Tensor,  # (N,) of the region, pixels
) -> tuple[Tensor, Tensor]:
    """The pixel (N,) of each cell whose middle is nearest to the cell's, from the region's border; whether any is."""
    begin, end = _first_pixel(cell, side), torch.minimum(_first_pixel(cell + 1, side), length)
    # The middle of a pixel lies half a pixel into it.
    middle = (cell + 0.5) * side - 0.5
    nearest = (middle - 0.5 - _ROUNDING_PX).ceil()
    return torch.minimum(torch.maximum(nearest, begin), end - 1).long(), end > begin


def _first_pixel(
    cell: Tensor,  # (N,)
    side: Tensor,  # (N,)
) -> Tensor:
    """The first pixel (N,) whose number over the side is at least that of the cell, as it is rounded."""
    near = (cell * side).ceil()
    too_early, too_late = torch.floor(near / side) < cell, torch.floor((near - 1) / side) >= cell
    return near + too_early.to(side.dtype) - too_late.to(side.dtype)
