"""Residual maps as coloured pictures over the dimmed image."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from directshape_torch.report.pictures import Window
from directshape_torch.report.residual_maps import pixel_grid
from directshape_torch.visualize.drawing import Picture

Floats = npt.NDArray[np.floating[Any]]

FULL_COLOUR_GREY_LEVELS = 40.0
# Of a sure pixel: -log(0.01).
FULL_COLOUR_SILHOUETTE = 4.6

_RED, _BLUE, _WHITE = (np.array(c, dtype=np.float64) for c in ((214, 47, 39), (49, 87, 200), (245, 245, 245)))
_SPILLED, _UNFILLED = (np.array(c, dtype=np.float64) for c in ((255, 140, 0), (186, 60, 220)))
_DIM = 0.5


def photometric_picture(image: Picture, window: Window, residual: Floats) -> Picture:
    """White where left and right agree, red where the right image is brighter, blue where it is darker.

    Args:
        image: (H, W, 3) left.
        window: of the car.
        residual: (h, w) grey levels, NaN where there is none.
    """
    known = np.isfinite(residual)
    share = np.clip(np.nan_to_num(residual) / FULL_COLOUR_GREY_LEVELS, -1, 1)[..., None]
    tint = np.where(share > 0, _RED, _BLUE)
    colour = _WHITE + np.abs(share) * (tint - _WHITE)
    return _uint8(np.where(known[..., None], colour, dimmed(image, window)))


def silhouette_picture(image: Picture, window: Window, residual: Floats) -> Picture:
    """Orange where the shape spills out of its mask, violet where it does not fill it, over the dimmed image."""
    strength = np.clip(np.abs(residual) / FULL_COLOUR_SILHOUETTE, 0, 1)[..., None] ** 0.7
    tint = np.where(residual[..., None] > 0, _SPILLED, _UNFILLED)
    base = dimmed(image, window)
    return _uint8(base + strength * (tint - base))


def dimmed(image: Picture, window: Window) -> Floats:
    """The image at the pixels of a map, darker and grey, (h, w, 3)."""
    grid = pixel_grid(window).long().numpy()
    grey = image[grid[..., 1], grid[..., 0]].mean(axis=-1, keepdims=True)
    return np.asarray(np.repeat(_DIM * grey, 3, axis=-1))


def _uint8(colours: Floats) -> Picture:
    return np.ascontiguousarray(np.round(np.clip(colours, 0, 255)).astype(np.uint8))
