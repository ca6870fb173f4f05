"""This module samples the pixels of a car, cell by cell, from the gradients of whole frames."""

from __future__ import annotations

from itertools import product

import torch
from torch import Tensor

from directshape_torch.config import SamplingConfig, SamplingMode
from directshape_torch.image.grey_levels import gradient_magnitude_of_part
from directshape_torch.observation.packing import cell_sides


def gradient_magnitude(
    images: Tensor,  # (F, 3, H, W)
    sizes: Tensor,  # (F, 2)
) -> Tensor:
    """Length of the image gradient of whole frames (F, H, W), 0 in their padding."""
    magnitude = torch.zeros_like(images[:, 0])
    for frame, (height, width) in enumerate(sizes.tolist()):
        whole = gradient_magnitude_of_part(images[frame], (height, width), (0, 0, width, height))
        magnitude[frame, :height, :width] = whole
    return magnitude


def select_pixels(
    magnitude: Tensor,  # (F, H, W)
    frame_index: Tensor,  # (B,)
    regions: Tensor,  # (B, 4)
    mode: SamplingMode,
    settings: SamplingConfig,
) -> tuple[Tensor, Tensor]:
    """Object (P,) and uv (P, 2) of the sampled pixels, cell by cell."""
    chosen: list[tuple[int, int, int]] = []
    for number, ((u0, v0, u1, v1), side) in enumerate(
        zip(regions.tolist(), cell_sides(regions, settings)[:, 0].tolist(), strict=True)
    ):
        own = magnitude[frame_index[number]].detach().float()
        side = 1.0 if mode == "dense" else side
        cells: dict[tuple[int, int], list[tuple[int, int]]] = {}
        for v, u in product(range(v0, v1), range(u0, u1)):
            cells.setdefault((int((v - v0) / side), int((u - u0) / side)), []).append((v, u))
        for (row, column), pixels in cells.items():
            middle = min(v0 + int((row + 0.5) * side), v1 - 1), min(u0 + int((column + 0.5) * side), u1 - 1)
            v, u = max(pixels, key=lambda at: _strength(own[at])) if mode == "adaptive" else middle
            chosen.append((number, u, v))
    found = torch.tensor(chosen, dtype=torch.long).reshape(-1, 3)
    return found[:, 0], found[:, 1:]


def _strength(magnitude: Tensor) -> float:
    return float(magnitude) if magnitude.isfinite() else 0.0
