"""Which pixels of the two images speak about the cars: those of their regions that a mode chooses and nothing hides.

The paper's mode ("adaptive", section "Adaptive Point Sampling") has two rounds: a threshold of the gradient magnitude
in each cell of 32 px (`gradient_cells`), then in each small cell, whose size follows the region's, the strongest pixel
above its threshold, else the strongest (`strongest_pixels`). The mode "uniform" takes the pixel nearest to the middle
of each small cell, without a look at any other (`even_pixels`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import groupby
from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.config import SamplingConfig
from directshape_torch.image.grey_levels import gradient_magnitude_at
from directshape_torch.numerics.tensors import pixels_at_once, portions
from directshape_torch.observation.gradient_cells import GradientCells, ImageRegion, gradient_cells
from directshape_torch.observation.occlusion import OcclusionCrops, Side
from directshape_torch.observation.regions import CellPixels, region_pixels, small_cell_side
from directshape_torch.observation.strongest_pixels import strongest_pixels
from directshape_torch.scene import Detections, FrameBatch


class ChosenPixels(NamedTuple):
    """P pixels of one image."""

    object_index: Tensor  # (P,)
    uv: Tensor  # (P, 2) integer
    gradient_magnitude: Tensor  # (P,)


def chosen_pixels(
    frames: FrameBatch,
    detections: Detections,
    regions: Tensor,  # (2 B, 4)
    hidden: OcclusionCrops | None,
    config: SamplingConfig,
) -> tuple[ChosenPixels, ChosenPixels]:
    """The chosen pixels that nothing hides, of the left and of the right image.

    Args:
        frames: F frames.
        detections: B cars.
        regions: (2 B, 4) integer (u0, v0, u1, v1), half open, those of the left image first.
        hidden: where nearer instances hide the cars, by row of the regions; None: nowhere.
        config: density and modes.
    """
    left, right = sampling_settings(config, "left"), sampling_settings(config, "right")
    if left.mode == right.mode:
        return _in_mode(frames, detections, regions, hidden, left)
    of_left, of_right = regions.tensor_split(2)
    nothing = torch.zeros_like(of_left)
    return (
        _in_mode(frames, detections, torch.cat([of_left, nothing]), hidden, left)[0],
        _in_mode(frames, detections, torch.cat([nothing, of_right]), hidden, right)[1],
    )


def sampling_settings(config: SamplingConfig, side: Side) -> SamplingConfig:
    """The configuration with the mode of that image."""
    mode = config.mode if side == "left" or config.mode_right == "as_left" else config.mode_right
    return replace(config, mode=mode)


def _in_mode(
    frames: FrameBatch,
    detections: Detections,
    regions: Tensor,  # (2 B, 4)
    hidden: OcclusionCrops | None,
    settings: SamplingConfig,
) -> tuple[ChosenPixels, ChosenPixels]:
    """Those of both images in one mode."""
    if settings.mode == "uniform":
        return _even_pixels(frames, detections, regions, hidden, settings)
    count = len(detections)
    images, sizes = (frames.images_left, frames.images_right), frames.sizes.tolist()
    boxes, frame = regions.tolist(), detections.frame_index.tolist()
    areas = [(u1 - u0) * (v1 - v0) for u0, v0, u1, v1 in boxes]
    # Cars of one frame stay together, where they are neighbours in the batch.
    runs = [list(run) for _, run in groupby(range(count), key=frame.__getitem__)]
    amounts = [sum(areas[n] + areas[count + n] for n in run) for run in runs]
    number = torch.arange(2 * count, device=regions.device)
    sides: tuple[list[ChosenPixels], list[ChosenPixels]] = ([], [])
    for part in portions(amounts, pixels_at_once(regions.device)) or [slice(0, 0)]:
        cars = [n for run in runs[part] for n in run]
        of_images = [ImageRegion(side, frame[n], boxes[side * count + n]) for side in (0, 1) for n in cars]
        cells = gradient_cells(images, sizes, of_images)
        begin, end = (cars[0], cars[-1] + 1) if cars else (0, 0)
        both = torch.cat([number[begin:end], number[count + begin : count + end]])
        visible = _visible(cells, regions[both], both, images[0].shape[3], hidden, settings)
        num_left = int((visible.object_index < count).sum())
        left, right = (ChosenPixels(*x) for x in zip(*(x.tensor_split([num_left]) for x in visible), strict=True))
        sides[0].append(left)
        sides[1].append(right._replace(object_index=right.object_index - count))
    left, right = (ChosenPixels(*(torch.cat(x) for x in zip(*parts, strict=True))) for parts in sides)
    return left, right


def _even_pixels(
    frames: FrameBatch,
    detections: Detections,
    regions: Tensor,  # (2 B, 4)
    hidden: OcclusionCrops | None,
    settings: SamplingConfig,
) -> tuple[ChosenPixels, ChosenPixels]:
    """Those of the mode that looks at no other pixels than it chooses."""
    count, found = len(detections), even_pixels(regions, settings)
    object_index, uv, _ = _unhidden(found, found.object_index, hidden)
    num_left = int((object_index < count).sum())

    def of_side(images: Tensor, part: slice, first_object: int) -> ChosenPixels:
        car = object_index[part] - first_object
        frame = detections.frame_index.index_select(0, car)
        return ChosenPixels(car, uv[part], gradient_magnitude_at(images, frames.sizes, frame, uv[part]))

    return (
        of_side(frames.images_left, slice(None, num_left), 0),
        of_side(frames.images_right, slice(num_left, None), count),
    )


def _visible(
    cells: GradientCells,
    regions: Tensor,  # (R, 4)
    number: Tensor,  # (R,) of each region among all of them
    image_width: int,
    hidden: OcclusionCrops | None,
    settings: SamplingConfig,
) -> ChosenPixels:
    """The chosen pixels of some regions that no instance hides."""
    found = _candidates(regions, cells, image_width, settings)
    object_index, uv, kept = _unhidden(found, number.index_select(0, found.object_index), hidden)
    magnitude = cells.magnitude_at(found.object_index.index_select(0, kept), uv)
    return ChosenPixels(object_index, uv, magnitude)


def _unhidden(found: CellPixels, object_index: Tensor, hidden: OcclusionCrops | None) -> tuple[Tensor, Tensor, Tensor]:
    """Objects (P,) and uv (P, 2) of the pixels that no instance hides, and which (P,) of those found they are."""
    uv, exists = torch.stack([found.u, found.v], 1), found.exists
    if hidden is not None:
        exists = exists & ~hidden.at(object_index, uv)
    kept = exists.nonzero()[:, 0]
    return object_index.index_select(0, kept), uv.index_select(0, kept), kept


def _candidates(regions: Tensor, cells: GradientCells, image_width: int, settings: SamplingConfig) -> CellPixels:
    """One pixel of each small cell, or every pixel in the mode "dense"; those that are hidden among them."""
    if settings.mode in ("adaptive", "round_one"):
        return strongest_pixels(cells, regions, image_width, settings)
    if settings.mode == "uniform":
        return even_pixels(regions, settings)
    object_index, uv = region_pixels(regions)
    return CellPixels(object_index, uv[:, 0], uv[:, 1], torch.ones_like(object_index, dtype=torch.bool))


@dataclass(frozen=True)
class PixelSelection:
    """Chosen pixels of B objects, sorted by object, hidden ones among them.

    Attributes:
        object_index: (P,) integer.
        uv: (P, 2) integer (column, row).
        above_threshold: (P,) bool, the pixel's gradient exceeds its threshold ("green" in the paper's figure).
    """

    object_index: Tensor
    uv: Tensor
    above_threshold: Tensor


def selected_pixels(
    images: Tensor,  # (F, 3, H, W)
    sizes: Tensor,  # (F, 2)
    frame_index: Tensor,  # (B,)
    regions: Tensor,  # (B, 4)
    settings: SamplingConfig,
) -> PixelSelection:
    """The pixels of one image before hidden ones leave, with the round that each comes from: for figures.

    Examples:
        >>> ramp = (torch.arange(40.0) / 20).square().expand(1, 3, 40, 40)
        >>> frame, region = torch.tensor([0]), torch.tensor([[5, 5, 25, 25]])
        >>> settings = SamplingConfig(min_pixels=100, max_pixels=100)
        >>> selected_pixels(ramp, torch.tensor([[40, 40]]), frame, region, settings).uv.shape
        torch.Size([100, 2])
    """
    boxes = [ImageRegion(0, *place) for place in zip(frame_index.tolist(), regions.tolist(), strict=True)]
    cells = gradient_cells([images], sizes.tolist(), boxes)
    found = _candidates(regions, cells, images.shape[3], settings)
    kept = found.exists.nonzero()[:, 0]
    object_index, uv = found.object_index[kept], torch.stack([found.u, found.v], dim=1)[kept]
    above = cells.magnitude_at(object_index, uv).float() > cells.threshold_at(object_index, uv).float()
    return PixelSelection(object_index, uv, above)


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

    Examples:
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
