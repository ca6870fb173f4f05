"""The sampled pixels of a car in both images (paper, figure)."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from directshape_torch.config import SamplingMode
from directshape_torch.io.figure_files import new_figure, write_figure
from directshape_torch.io.instance_masks import SIDES
from directshape_torch.observation.occlusion import Side, occlusion_map
from directshape_torch.observation.packing import car_regions
from directshape_torch.observation.refinable import without_empty_masks
from directshape_torch.observation.sampling import sampled_pixels
from directshape_torch.visualize.inspection.car_view import CarView
from directshape_torch.visualize.inspection.panels import draw_lines, show_crop

_PANEL_INCHES, _ROOM_INCHES = 6.0, 0.8
_INKS: dict[SamplingMode, str] = {"adaptive": "lime", "uniform": "yellow", "dense": "yellow"}
_CHOSEN: dict[SamplingMode, str] = {
    "adaptive": "by their gradient",
    "uniform": "evenly spaced",
    "dense": "of the whole region",
}


class SampledPixels(NamedTuple):
    """Pixels of one car in one image that its terms look at."""

    uv: NDArray[np.int64]  # (P, 2)
    num_hidden: int  # chosen pixels that a nearer instance hides: they are left out
    mode: SamplingMode

    @property
    def in_words(self) -> str:
        """How many there are, and why."""
        return f"{len(self.uv)} {_CHOSEN[self.mode]}, {self.num_hidden} hidden"


def sampled_pixels_of(view: CarView, side: Side) -> SampledPixels:
    """The pixels as the refinement chose them."""
    config = view.trace.config.sampling
    frames, detections = view.loaded.frame, without_empty_masks(view.loaded.detections)
    left, right = car_regions(frames, detections)
    images, regions, mode = (
        (frames.images_left, left, config.mode) if side == "left" else (frames.images_right, right, config.mode_right)
    )
    of, uv = sampled_pixels(images, frames.sizes, detections.frame_index, regions, mode, config)
    uv = uv[of == view.car]
    hidden = occlusion_map(detections, side, config.occlusion_order).at(torch.tensor(view.car).to(uv.device), uv)
    kept = ~hidden if config.occlusion else torch.ones_like(hidden)
    return SampledPixels(np.asarray(uv[kept].cpu()), int((~kept).sum()), mode)


def write_sampling_figure(path: Path | str, view: CarView) -> None:
    """Write the figure as PNG, both images side by side.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    figure = new_figure(2 * _PANEL_INCHES, _PANEL_INCHES * view.panel_aspect() + _ROOM_INCHES, "drawing sampled pixels")
    figure.suptitle(view.title)
    for axes, side in zip(figure.subplots(1, 2), SIDES, strict=True):
        pixels = sampled_pixels_of(view, side)
        show_crop(axes, view.image(side), view.window(side), f"{side}: {pixels.in_words}")
        draw_lines(axes, view.mask_lines(side), "white", "mask", linewidth=1.0)
        axes.plot(*pixels.uv.T, ".", color=_INKS[pixels.mode], markersize=4, label=_CHOSEN[pixels.mode])
        axes.legend(loc="lower right", fontsize=8, facecolor="0.3", labelcolor="white")
    write_figure(path, figure)
