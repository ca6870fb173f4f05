"""Silhouette residuals of both images and photometric residuals, at the input and at the end (paper, both panels)."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.io.figure_files import new_figure, write_figure
from directshape_torch.io.instance_masks import SIDES
from directshape_torch.observation.occlusion import Side
from directshape_torch.observation.packing import PixelSamples
from directshape_torch.terms.cars import CarState
from directshape_torch.terms.photometric import Photometric, Surface
from directshape_torch.terms.silhouette import MaskRows
from directshape_torch.terms.term import Part
from directshape_torch.visualize.inspection.car_view import CarView
from directshape_torch.visualize.inspection.panels import draw_lines, show_crop
from directshape_torch.visualize.refinement_trace import RefinementTrace


class PixelResiduals(NamedTuple):
    """P pixels of one car with what the cost says of them."""

    uv: NDArray[np.float64]  # (P, 2) full-resolution pixels
    value: NDArray[np.float64]  # (P,)
    lost: NDArray[np.bool_]  # (P,) there is nothing to compare, and the pixel pays a constant


class CarResiduals(NamedTuple):
    """What the images say of one car; no pixels where there is no such term."""

    silhouette_left: PixelResiduals  # `-log` of the probability of the mask; a ray that passes by is not lost
    silhouette_right: PixelResiduals
    photometric: PixelResiduals  # right less left, grey levels, mean over the part of the neighbourhood on the car


class _Pixels(NamedTuple):
    """Pixels of all cars: `PixelResiduals` with the car of each."""

    car: Tensor
    uv: Tensor
    value: Tensor
    lost: Tensor

    def of_car(self, place: int) -> PixelResiduals:
        uv, value, lost = (x[self.car == place].cpu().numpy() for x in self[1:])
        return PixelResiduals(uv.astype(np.float64), value.astype(np.float64), lost)


@torch.no_grad()
def car_residuals(trace: RefinementTrace, number: int) -> dict[int, CarResiduals]:
    """Residuals for state `number` of the trace of each car that took part, by its row among the detections."""
    stage, state = trace.last_stage, CarState(*(x[trace.rows] for x in trace.states[number]))
    figures = stage.figures(stage.problem.look(state))
    nothing = torch.zeros(0)
    parts = dict.fromkeys(CarResiduals._fields, _Pixels(nothing, nothing.view(0, 2), nothing, nothing.bool()))
    for term, at in zip(stage.terms, figures.parts, strict=True):
        for side, pixels in enumerate((trace.pixels.left, trace.pixels.right)):
            if term.names == CarResiduals._fields[:2]:
                parts[term.names[side]] = _of_silhouette(stage.problem.masks, side, pixels, at)
    photometric, at_photometric = stage.photometric, stage.photometric_part(figures)
    if photometric is not None and at_photometric is not None:
        parts["photometric"] = _of_photometry(photometric, at_photometric)
    return {
        car: CarResiduals(*(parts[name].of_car(place) for name in CarResiduals._fields))
        for place, car in enumerate(trace.rows.tolist())
    }


def _of_silhouette(masks: MaskRows, side: int, pixels: PixelSamples, at: Part) -> _Pixels:
    mine = (masks.filled > 0) & (masks.side == side)[:, None]
    value = at.residual[..., 0][mine]
    return _Pixels(pixels.object_index, pixels.uv, value, torch.zeros_like(value, dtype=torch.bool))


def _of_photometry(term: Photometric, at: Part) -> _Pixels:
    fixed, left = term.pixel_set, term.left
    assert left is not None, "a stage of all cars has all pixels"
    counted = fixed.rows.pixel_weight > 0
    weight = fixed.rows.neighbour_weight.movedim(0, -1)
    mean = (at.residual * weight).sum(dim=-1) / weight.sum(dim=-1).clamp_min(1)
    pixel = left.packed.row.flatten()[fixed.sight_place]
    car = fixed.blocks.owner[:, None].expand_as(counted)
    return _Pixels(car[counted], left.pixels.uv[pixel[counted]], mean[counted], ~Surface(*at.where).usable[counted])


_PANEL_INCHES = 3.6
_WIDTH_INCHES = 3 * _PANEL_INCHES + 0.4
# Of titles and colour bars.
_ROOM_INCHES = 2.3
# -log 0.01: what a pixel pays whose mask is certain and wrong.
_WORST_SILHOUETTE = 4.6
_CONTOUR_INK = "cyan"
# Of the largest dot, by area.
_LEAST_DOT = 0.2


def write_residual_figure(path: Path | str, view: CarView) -> None:
    """Write the figure as PNG: the input above, the end below; the shape's outline is drawn over its residuals.

    Lost pixels, those that cannot be compared with the right image, are crosses.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    height_inches = 2 * _PANEL_INCHES * view.panel_aspect() + _ROOM_INCHES
    figure = new_figure(_WIDTH_INCHES, height_inches, "drawing residuals")
    figure.suptitle(view.title)
    axes = figure.subplots(2, 3)
    grey_levels = view.trace.config.photometric.lost_grey_levels
    for row, (number, name) in enumerate(((0, "before"), (len(view.trace) - 1, "after"))):
        *silhouettes, photometry = car_residuals(view.trace, number)[view.car]
        for column, (side, values) in enumerate(zip(SIDES, silhouettes, strict=True)):
            title = f"{name}: silhouette {side}, mean {_mean(values)}"
            _backdrop(axes[row, column], view, side, number, title)
            silhouette = _dots(axes[row, column], values, "inferno", (0, _WORST_SILHOUETTE))
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
    show_crop(axes, view.image(side), view.window(side), title, dimmed=True)
    draw_lines(axes, view.contours(side, number), _CONTOUR_INK, linewidth=0.8)


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
