"""The strongest pixel of each small cell, found by whole lines of threshold cells instead of single pixels.

A line is what a row of one small cell's region has in common with a threshold cell. Lines of the same small cells are
compared element by element first; only their best elements are brought together one by one.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.config import SamplingConfig
from directshape_torch.observation.gradient_cells import GradientCells
from directshape_torch.observation.regions import CellPixels, small_cell_side

_INT32_MIN, _INT64_MIN = torch.iinfo(torch.int32).min, torch.iinfo(torch.int64).min


def strongest_pixels(
    cells: GradientCells,
    regions: Tensor,  # (B, 4)
    image_width: int,
    settings: SamplingConfig,
) -> CellPixels:
    """Of each small cell the strongest pixel above its threshold, else the strongest; the first of equals, row-major.

    In the mode "round_one" only the former. Gradients are compared in float32, whatever the input, and one that is not
    finite is 0.

    Args:
        cells: magnitudes and thresholds around the regions.
        regions: (B, 4) integer, half open, within their frames.
        image_width: of the frames with padding.
        settings: density and mode.
    """
    grid = _SmallCells.of(regions, settings)
    bands = _bands(cells, regions, grid, image_width)
    best, row = _best_of_lines(cells, bands)
    column = torch.arange(cells.side_px, dtype=torch.int32, device=regions.device)
    # The first of equals is the one whose reversed position is largest.
    reversed_position = row.mul_(-image_width).sub_((bands.position.int() + 1)[:, None]).sub_(column)
    key = torch.stack([reversed_position, best], dim=-1).view(torch.int64)[..., 0]
    found = key.new_full((grid.total,), _INT64_MIN)
    found.scatter_reduce_(0, bands.small_cell.flatten(), key.flatten(), "amax")
    found.index_fill_(0, grid.beyond(), _INT64_MIN)
    lower, upper = found.view(torch.int32).view(-1, 2).unbind(1)
    exists = found != _INT64_MIN
    if settings.mode == "round_one":
        exists &= upper >= 0
    position = (-1 - lower.long()).clamp_min_(0)
    v = torch.div(position, image_width, rounding_mode="floor")
    return CellPixels(grid.object_index(), position - v * image_width, v, exists)


def _ranks(
    magnitude: Tensor,  # (Q, side)
    threshold: Tensor,  # (Q, 1) float32
) -> Tensor:
    """Integers (Q, side) that rise with what is preferred: above the threshold, then strength, not finite as 0.

    The bits of floats that are not negative are ordered as the floats are; the sign bit puts all that are not above
    their threshold behind.
    """
    magnitude = magnitude.detach().float()
    below = (magnitude > threshold).logical_not_()
    ranks = magnitude.nan_to_num(nan=0.0, posinf=0.0).view(torch.int32)
    return ranks.add_(below, alpha=_INT32_MIN)


class _SmallCells(NamedTuple):
    """The grids of small cells of B regions; each row ends with one more, for pixels beyond the region."""

    side: Tensor  # (B,) float64, pixels
    rows: Tensor  # (B,)
    columns: Tensor  # (B,) with the one more
    start: Tensor  # (B,) number of the first cell
    total: int
    total_rows: int
    height: int  # of all regions together, pixels

    @classmethod
    def of(cls, regions: Tensor, settings: SamplingConfig) -> _SmallCells:
        side = small_cell_side(regions, settings)
        widths, heights = (regions[:, 2:] - regions[:, :2]).unbind(1)
        rows, columns = ((length / side).ceil().long() for length in (heights, widths))
        columns += 1
        count = rows * columns
        totals = torch.stack([count.sum(), rows.sum(), heights.sum()]).tolist()
        return cls(side, rows, columns, count.cumsum(0) - count, *totals)

    def object_index(self) -> Tensor:
        """(N,) of each cell."""
        return _numbers(self.rows).repeat_interleave(self.rows * self.columns, output_size=self.total)

    def beyond(self) -> Tensor:
        """The last cell of every row."""
        of = _numbers(self.rows).repeat_interleave(self.rows, output_size=self.total_rows)
        row = torch.arange(self.total_rows, device=of.device) - (self.rows.cumsum(0) - self.rows)[of]
        return self.start[of] + (row + 1) * self.columns[of] - 1


class _Bands(NamedTuple):
    """Q bands: rows that one row of small cells and one threshold cell have in common."""

    cell: Tensor  # (Q,) threshold cell
    first_line: Tensor  # (Q,) among the lines of all threshold cells
    with_further: list[int]  # how many bands, the first ones, have a second line, a third one, ...
    position: Tensor  # (Q,) of the first pixel in its image
    small_cell: Tensor  # (Q, side) of each column


def _bands(cells: GradientCells, regions: Tensor, grid: _SmallCells, image_width: int) -> _Bands:
    side = cells.side_px
    u0, v0, _, v1 = regions.unbind(1)
    # Rows of pixels of all regions, then the first one of each band.
    of = _numbers(u0).repeat_interleave(v1 - v0, output_size=grid.height)
    row = torch.arange(grid.height, device=regions.device) - ((v1 - v0).cumsum(0) - (v1 - v0))[of]
    small_row, v = (row / grid.side[of]).floor().long(), row + v0[of]
    begins = (row == 0) | (v % side == 0)
    begins[1:] |= small_row[1:] != small_row[:-1]
    first = begins.nonzero()[:, 0]
    num_lines = torch.diff(first, append=first.new_full((1,), grid.height))
    # The longest first, so that those with a further line are always the first so many.
    num_lines, order = num_lines.sort(descending=True, stable=True)
    first = first[order]
    of, v, small_row = (x.index_select(0, first) for x in (of, v, small_row))
    # Each of them in every column of threshold cells.
    columns = _Columns.of(regions, grid, side)
    number, left, start = (x.index_select(0, of) for x in (columns.number, columns.first, columns.start))
    by_length = torch.zeros(side + 1, dtype=torch.long, device=of.device).index_add_(0, num_lines, number)
    total, *with_further = by_length.flip(0).cumsum(0).flip(0)[1:].tolist()
    row_of_cells = torch.div(v, side, rounding_mode="floor")
    in_first_column = torch.stack(
        [
            number.cumsum(0) - number,
            cells.first.index_select(0, of) + row_of_cells * cells.columns.index_select(0, of) + left,
            v - row_of_cells * side,
            v * image_width + left * side,
            start,
            grid.start.index_select(0, of) + small_row * grid.columns.index_select(0, of),
        ],
        dim=1,
    )
    band = _numbers(of).repeat_interleave(number, output_size=total)
    first_of_row, cell, line, position, start, small_cell = in_first_column.index_select(0, band).unbind(1)
    column = _numbers(band) - first_of_row
    cell = cell + column
    small_cells = columns.small_column.index_select(0, start + column).add_(small_cell[:, None])
    return _Bands(cell, cell * side + line, with_further, position + column * side, small_cells)


class _Columns(NamedTuple):
    """Columns of threshold cells of B regions."""

    first: Tensor  # (B,)
    number: Tensor  # (B,) how many
    start: Tensor  # (B,) number of the first among those of all regions
    small_column: Tensor  # (columns of all regions, side) column of small cells of each pixel

    @classmethod
    def of(cls, regions: Tensor, grid: _SmallCells, side: int) -> _Columns:
        u0, _, u1, _ = regions.unbind(1)
        first = torch.div(u0, side, rounding_mode="floor")
        number = torch.div(u1 - 1, side, rounding_mode="floor") - first + 1
        start = number.cumsum(0) - number
        of = _numbers(u0).repeat_interleave(number)
        corner = (first[of] + _numbers(of) - start[of]) * side - u0[of]
        within = corner[:, None] + torch.arange(side, device=regions.device)
        small_column = (within / grid.side[of, None]).floor().long()
        inside = (within >= 0) & (within < (u1 - u0)[of, None])
        return cls(first, number, start, torch.where(inside, small_column, grid.columns[of, None] - 1))


def _best_of_lines(cells: GradientCells, bands: _Bands) -> tuple[Tensor, Tensor]:
    """The largest rank of each column of all bands (Q, side), and the first line with it, counted from their own."""
    lines = cells.magnitude.detach().view(-1, cells.side_px)
    threshold = cells.thresholds.index_select(0, bands.cell).float()[:, None]
    best = _ranks(lines.index_select(0, bands.first_line), threshold)
    line = torch.zeros_like(best)
    for number, count in enumerate(bands.with_further, start=1):
        if not count:
            break
        other = _ranks(lines.index_select(0, bands.first_line[:count] + number), threshold[:count])
        so_far = best[:count]
        line[:count].masked_fill_(other > so_far, number)
        torch.maximum(so_far, other, out=so_far)
    return best, line


def _numbers(rows: Tensor) -> Tensor:
    """0, 1, 2, ... of the rows of a tensor."""
    return torch.arange(len(rows), device=rows.device)
