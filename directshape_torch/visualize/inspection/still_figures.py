"""Still figures of a car (paper): its sampled pixels, and their residuals before and after."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

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
from directshape_torch.visualize.inspection.car_view import CarView, draw_lines
from directshape_torch.visualize.inspection.pixel_residuals import PixelResiduals, car_residuals

_SAMPLING_INCHES, _SAMPLING_ROOM_INCHES = 6.0, 0.8
_INKS: dict[SamplingMode, str] = {"adaptive": "lime", "uniform": "yellow", "dense": "yellow"}
_CHOSEN: dict[SamplingMode, str] = {
    "adaptive": "by their gradient",
    "uniform": "evenly spaced",
    "dense": "of the whole region",
}
_PANEL_INCHES = 3.6
# Of titles and colour bars.
_ROOM_INCHES = 2.3
# -log 0.01: what a pixel pays whose mask is certain and wrong.
WORST_SILHOUETTE = 4.6
# Of the largest dot, by area.
_LEAST_DOT = 0.2


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
    """Write the sampled pixels as PNG, both images side by side."""
    height_inches = _SAMPLING_INCHES * view.panel_aspect() + _SAMPLING_ROOM_INCHES
    figure = new_figure(2 * _SAMPLING_INCHES, height_inches, "drawing sampled pixels")
    figure.suptitle(view.title)
    for axes, side in zip(figure.subplots(1, 2), SIDES, strict=True):
        pixels = sampled_pixels_of(view, side)
        view.show(axes, side, f"{side}: {pixels.in_words}")
        draw_lines(axes, view.mask_lines(side), "white", "mask", linewidth=1.0)
        axes.plot(*pixels.uv.T, ".", color=_INKS[pixels.mode], markersize=4, label=_CHOSEN[pixels.mode])
        axes.legend(loc="lower right", fontsize=8, facecolor="0.3", labelcolor="white")
    write_figure(path, figure)


def write_residual_figure(path: Path | str, view: CarView) -> None:
    """Write the residuals as PNG: the input above, the end below; the shape's outline is drawn over its residuals.

    Lost pixels, those that cannot be compared with the right image, are crosses.
    """
    height_inches = 2 * _PANEL_INCHES * view.panel_aspect() + _ROOM_INCHES
    figure = new_figure(3 * _PANEL_INCHES + 0.4, height_inches, "drawing residuals")
    figure.suptitle(view.title)
    axes = figure.subplots(2, 3)
    grey_levels = view.trace.config.photometric.lost_grey_levels
    for row, (number, name) in enumerate(((0, "before"), (len(view.trace) - 1, "after"))):
        *silhouettes, photometry = car_residuals(view.trace, number)[view.car]
        for panel, side, values in zip(axes[row], SIDES, silhouettes, strict=False):
            _backdrop(panel, view, side, number, f"{name}: silhouette {side}, mean {_mean(values)}")
            silhouette = _dots(panel, values, "inferno", (0, WORST_SILHOUETTE))
        title = f"{name}: photometric, mean |r| {_mean(photometry)}, lost {int(photometry.lost.sum())}"
        _backdrop(axes[row, 2], view, "left", number, title)
        photometric = _dots(axes[row, 2], photometry, "RdBu_r", (-2 * grey_levels, 2 * grey_levels))
    bars = {"orientation": "horizontal", "aspect": 40, "shrink": 0.7}
    figure.colorbar(silhouette, ax=axes[:, :2], label="silhouette residual", **bars)
    figure.colorbar(photometric, ax=axes[:, 2], label="right less left [grey levels]", extend="both", **bars)
    write_figure(path, figure)


def _mean(values: PixelResiduals) -> str:
    counted = np.abs(values.value[~values.lost])
    return f"{counted.mean():.2f}" if len(counted) else "-"


def _backdrop(axes: Any, view: CarView, side: Side, number: int, title: str) -> None:
    view.show(axes, side, title, dimmed=True)
    draw_lines(axes, view.contours(side, number), "cyan", linewidth=0.8)


def _dots(axes: Any, values: PixelResiduals, colours: str, limits: tuple[float, float]) -> Any:
    (u0, u1), (v1, v0) = axes.get_xlim(), axes.get_ylim()
    # As large as the samples lie apart.
    apart_px = ((u1 - u0) * (v1 - v0) / max(len(values.uv), 1)) ** 0.5
    points_per_px = 72 * _PANEL_INCHES * 0.9 / max(u1 - u0, (v1 - v0) * 1.5)
    size = float(np.clip(0.7 * apart_px * points_per_px, 1.5, 7)) ** 2
    lost, kept = values.uv[values.lost], values.uv[~values.lost]
    axes.scatter(lost[:, 0], lost[:, 1], s=size, marker="x", color="0.75", linewidths=0.6)
    value = values.value[~values.lost]
    # What costs nothing leaves the image to be seen.
    sizes = size * np.clip(np.abs(value) / limits[1], _LEAST_DOT, 1)
    return axes.scatter(kept[:, 0], kept[:, 1], c=value, s=sizes, cmap=colours, vmin=limits[0], vmax=limits[1])
