"""How many pixels a car gets, and which."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from directshape_torch.errors import InputError

SamplingMode = Literal["adaptive", "round_one", "uniform", "dense"]


@dataclass(frozen=True)
class SamplingSettings:
    """How many pixels a car gets, and which.

    Attributes:
        mode: "adaptive": both rounds; "round_one": only pixels above their threshold; "uniform": the pixel nearest to
            the centre of each cell; "dense": every pixel of the region.
        density: wanted pixels per pixel of the region.
        min_pixels, max_pixels: bounds of the wanted number; a region of fewer pixels gives all it has.
        threshold_cell_px: side of the cells of the threshold.
        threshold_offset_grey: added to the smoothed median, grey levels of 0..255.
    """

    mode: SamplingMode = "adaptive"
    density: float = 0.05
    min_pixels: int = 100
    max_pixels: int = 3000
    threshold_cell_px: int = 32
    threshold_offset_grey: float = 7.0

    def __post_init__(self) -> None:
        if self.mode not in ("adaptive", "round_one", "uniform", "dense"):
            raise InputError("mode", "'adaptive', 'round_one', 'uniform' or 'dense'", repr(self.mode))
        if not 0 < self.density <= 1:
            raise InputError("density", "a share in (0, 1]", f"{self.density}")
        if not 1 <= self.min_pixels <= self.max_pixels:
            raise InputError("min_pixels", f"1..max_pixels ({self.max_pixels})", f"{self.min_pixels}")
        if self.threshold_cell_px < 1:
            raise InputError("threshold_cell_px", "at least 1", f"{self.threshold_cell_px}")


DEFAULT_SETTINGS = SamplingSettings()
