"""Which pixels of its region a car gets: one of each small cell, or all of them.

Square cells fill the region, as many as pixels are wanted (paper, section "Adaptive Point Sampling", round 2).
The mode "adaptive" takes the pixel of each cell at which the image changes most, "uniform" the one in its middle.
"""

from __future__ import annotations

import torch
from torch import Tensor

from directshape_torch.config import SamplingConfig, SamplingMode
from directshape_torch.image.grey_levels import gradient_magnitude_of_part


def sampled_pixels(
    images: Tensor,  # (F, 3, H, W)
    sizes: Tensor,  # (F, 2)
    frame_index: Tensor,  # (B,)
    regions: Tensor,  # (B, 4)
    mode: SamplingMode,
    settings: SamplingConfig,
) -> tuple[Tensor, Tensor]:
    """Pixels of B regions in one image side, hidden ones among them: object (P,) ascending and integer uv (P, 2).

    Examples:
        >>> ramp = (torch.arange(40.0) / 40).square().expand(1, 3, 40, 40)
        >>> settings = SamplingConfig(min_pixels=4, max_pixels=4)
        >>> region = torch.tensor([[5, 5, 25, 25]])
        >>> for mode in "adaptive", "uniform":
        ...     sampled_pixels(ramp, torch.tensor([[40, 40]]), torch.tensor([0]), region, mode, settings)[1].tolist()
        [[14, 5], [24, 5], [14, 15], [24, 15]]
        [[10, 10], [20, 10], [10, 20], [20, 20]]
    """
    side = torch.ones_like(regions[:, :1]) if mode == "dense" else cell_sides(regions, settings)
    if mode == "adaptive":
        return _strongest_pixels(images, sizes, frame_index, regions, side)
    return _middle_pixels(regions, side)


def cell_sides(
    regions: Tensor,  # (B, 4)
    settings: SamplingConfig,
) -> Tensor:
    """Side of the cells of each region, (B, 1) float64, pixels: `sqrt(h w / n)` with `n = clip(density h w, min, max)`.

    They are laid from the region's upper left corner and are never below one pixel, so a tiny region gives every pixel
    it has. (The paper counts the detection's box; the region is used so that the density in it is the wanted one.)
    """
    areas = (regions[:, 2:] - regions[:, :2]).double().prod(dim=1, keepdim=True)
    wanted = (settings.density * areas).clamp(settings.min_pixels, settings.max_pixels)
    return (areas / wanted).sqrt().clamp(min=1.0)


def _cells(regions: Tensor, side: Tensor) -> Tensor:
    """Columns and rows (B, 2) of cells with a pixel; a pixel belongs to the cell that its upper left corner lies in."""
    return ((regions[:, 2:] - regions[:, :2] - 1) / side).floor().long() + 1


def _middle_pixels(
    regions: Tensor,  # (B, 4)
    side: Tensor,  # (B, 1)
) -> tuple[Tensor, Tensor]:
    """The pixel in the middle of each cell, or the last one of the region where the middle lies beyond it."""
    cells = _cells(regions, side)
    count = cells.prod(dim=1)
    of = torch.arange(len(regions), device=regions.device).repeat_interleave(count)
    place = torch.arange(len(of), device=regions.device) - (count.cumsum(0) - count)[of]
    row = torch.div(place, cells[of, 0], rounding_mode="floor")
    cell = torch.stack([place - row * cells[of, 0], row], dim=1)
    middle = ((cell + 0.5) * side[of]).long() + regions[of, :2]
    return of, middle.minimum(regions[of, 2:] - 1)


@torch.no_grad()
def _strongest_pixels(
    images: Tensor,  # (F, 3, H, W)
    sizes: Tensor,  # (F, 2)
    frame_index: Tensor,  # (B,)
    regions: Tensor,  # (B, 4)
    side: Tensor,  # (B, 1)
) -> tuple[Tensor, Tensor]:
    """Of each cell the pixel of the largest gradient magnitude."""
    cells = _cells(regions, side)
    sizes_hw, found = sizes.tolist(), [regions.new_zeros(0, 2)]
    places = zip(frame_index.tolist(), regions.tolist(), side[:, 0].tolist(), cells.tolist(), strict=True)
    for frame, box, side_px, grid in places:
        if min(grid):
            place = _first_largest(gradient_magnitude_of_part(images[frame], sizes_hw[frame], box), side_px, *grid)
            width = box[2] - box[0]
            row = torch.div(place, width, rounding_mode="floor")
            found.append(torch.stack([box[0] + place - row * width, box[1] + row], dim=1))
    of = torch.arange(len(regions), device=regions.device).repeat_interleave(cells.prod(dim=1))
    return of, torch.cat(found)


def _first_largest(
    values: Tensor,  # (H, W), not negative
    side: float,
    columns: int,
    rows: int,
) -> Tensor:
    """Of each cell the place (rows columns,) of the largest value, the first of equals; one that is not finite is 0."""
    row, column = (
        (torch.arange(length, device=values.device, dtype=torch.float64) / side).long() for length in values.shape
    )
    cell = row[:, None] * columns + column
    # The bits of such numbers are ordered as the numbers are. Among equals the place decides, counted from the end.
    bits = values.float().nan_to_num(nan=0.0, posinf=0.0).view(torch.int32).long().flatten()
    from_end = torch.arange(len(bits) - 1, -1, -1, device=values.device)
    best = bits.new_zeros(rows * columns).scatter_reduce_(0, cell.flatten(), (bits << 32) + from_end, "amax")
    return len(bits) - 1 - (best & 0xFFFFFFFF)
