"""Which pixels of the two images speak about the cars: those of their regions that a mode chooses and nothing hides."""

from __future__ import annotations

from dataclasses import replace
from itertools import groupby
from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.config import SamplingConfig
from directshape_torch.image.grey_levels import gradient_magnitude_at
from directshape_torch.numerics.tensors import pixels_at_once, portions
from directshape_torch.observation.even_pixels import even_pixels
from directshape_torch.observation.gradient_cells import GradientCells, ImageRegion, gradient_cells
from directshape_torch.observation.occlusion import OcclusionCrops, Side
from directshape_torch.observation.pixel_sampling import candidate_pixels
from directshape_torch.observation.regions import RegionPixels
from directshape_torch.observation.small_cells import CellPixels
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
    """The visible ones of the pixels that `select_pixels` chooses, of the left and of the right image.

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
    if settings.mode in ("adaptive", "round_one"):
        return strongest_pixels(cells, regions, image_width, settings)
    # The mode "dense" does not look at the image.
    pixels = RegionPixels.of(regions)
    unseen = torch.zeros(len(pixels), device=regions.device)
    chosen = candidate_pixels(pixels, regions, unseen, unseen > 0, settings)
    object_index, uv = pixels.uv_of(chosen.pixel)
    return CellPixels(object_index, uv[:, 0], uv[:, 1], chosen.exists)
