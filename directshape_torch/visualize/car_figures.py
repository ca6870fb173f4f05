"""Figures of a car (paper): sampled pixels, residuals, the course of its refinement, the drift without photometry."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from directshape_torch.config import SamplingMode
from directshape_torch.io.figure_files import figure_picture, new_figure, write_animation, write_figure
from directshape_torch.io.instance_masks import SIDES
from directshape_torch.observation.occlusion import Side, occlusion_map
from directshape_torch.observation.packing import car_regions, sampled_pixels
from directshape_torch.observation.refinable import without_empty_masks
from directshape_torch.visualize.car_view import CarView, draw_lines, footprint_of_corners
from directshape_torch.visualize.drawing import Picture
from directshape_torch.visualize.refinement_trace import PixelResiduals, car_residuals

_SAMPLING_INCHES, _SAMPLING_ROOM_INCHES = 6.0, 0.8
# Of sampled pixels: the words for how they were chosen, and their ink.
_CHOSEN: dict[SamplingMode, tuple[str, str]] = {
    "adaptive": ("by their gradient", "lime"),
    "uniform": ("evenly spaced", "yellow"),
    "dense": ("of the whole region", "yellow"),
}
_PANEL_INCHES, _ROOM_INCHES = 3.6, 2.3  # of residuals; titles and colour bars need room
WORST_SILHOUETTE = 4.6  # -log 0.01: what a pixel pays whose mask is certain and wrong
_LEAST_DOT = 0.2  # of the largest one, by area
_ANIMATION_INCHES, _SECONDS_A_STEP, _SECONDS_AT_END = (13.5, 3.3), 0.35, 2.5
_DRIFT_INCHES = (14.5, 5.6)
_INKS = {"silhouettes alone": "crimson", "all terms": "royalblue"}
_BIRDS_EYE_MARGIN_M = 0.7


def sampled_pixels_of(view: CarView, side: Side) -> tuple[NDArray[np.int64], int, SamplingMode]:
    """The pixels (P, 2) as the refinement chose them, how many a nearer instance hides, and the way of choosing."""
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
    return np.asarray(uv[kept].cpu()), int((~kept).sum()), mode


def write_sampling_figure(path: Path | str, view: CarView) -> None:
    """Write the sampled pixels as PNG, both images side by side."""
    height_inches = _SAMPLING_INCHES * view.panel_aspect() + _SAMPLING_ROOM_INCHES
    figure = new_figure(2 * _SAMPLING_INCHES, height_inches, "drawing sampled pixels")
    figure.suptitle(view.title)
    for axes, side in zip(figure.subplots(1, 2), SIDES, strict=True):
        uv, num_hidden, mode = sampled_pixels_of(view, side)
        words, ink = _CHOSEN[mode]
        view.show(axes, side, f"{side}: {len(uv)} {words}, {num_hidden} hidden")
        draw_lines(axes, view.mask_lines(side), "white", "mask", linewidth=1.0)
        axes.plot(*uv.T, ".", color=ink, markersize=4, label=words)
        axes.legend(loc="lower right", fontsize=8, facecolor="0.3", labelcolor="white")
    write_figure(path, figure)


def write_residual_figure(path: Path | str, view: CarView) -> None:
    """Write the residuals as PNG: the input above, the end below; pixels that cannot be compared are crosses."""
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


def costs_of_car(view: CarView) -> dict[str, NDArray[np.float64]]:
    """Cost (N + 1,) of each term by its name, at the final stage's settings, and their "sum"."""
    costs = view.trace.costs[:, view.car].cpu().numpy()
    named = dict(zip(view.trace.result.term_names, costs.T, strict=True))
    return {**named, "sum": costs.sum(axis=1)}


def write_iteration_animation(path: Path | str, view: CarView) -> None:
    """Write the GIF: contour in both images, box from above, and costs, for every state that the car moved to."""
    frames = animation_frames(view)
    write_animation(path, frames, [_SECONDS_A_STEP] * (len(frames) - 1) + [_SECONDS_AT_END])


def animation_frames(view: CarView) -> list[Picture]:
    """One picture (h, w, 3) for each of `view.steps`."""
    figure = new_figure(*_ANIMATION_INCHES, "drawing an animation")
    panels = figure.subplots(1, 4, width_ratios=[2.7, 2.7, 1.9, 1.7])
    *images, above, costs = panels
    for axes, side in zip(images, SIDES, strict=True):
        view.show(axes, side, side)
        draw_lines(axes, view.mask_lines(side), "white", linewidth=1.2, linestyle=":")
    figure.suptitle(view.title, fontsize=9)
    _show_from_above(above, view, view.footprints[view.steps])
    _draw_cost_curves(costs, view)
    # The parts find their places once: they would dance if every picture were laid out anew.
    figure_picture(figure)
    figure.set_layout_engine("none")
    return [_frame(figure, panels, view, place) for place in range(len(view.steps))]


def _frame(figure: Any, panels: Sequence[Any], view: CarView, place: int) -> Picture:
    inks, number = _step_inks(len(view.steps)), view.steps[place]
    known = [(axes, len(axes.lines)) for axes in panels]
    *images, above, costs = panels
    figure.suptitle(f"{view.title}, iteration {number}", fontsize=9)
    for axes, side in zip(images, SIDES, strict=True):
        draw_lines(axes, view.contours(side, number), inks[place], linewidth=2.0)
    for earlier in range(place):
        _draw_footprint(above, view.footprints[view.steps[earlier]], inks[earlier], linewidth=0.5)
    _draw_footprint(above, view.footprints[number], inks[place], linewidth=2.0)
    costs.axvline(number, color="crimson", linewidth=1.0)
    picture = figure_picture(figure)
    for axes, count in known:
        for line in list(axes.lines)[count:]:
            line.remove()
    return picture


def _draw_cost_curves(axes: Any, view: CarView) -> None:
    for name, values in costs_of_car(view).items():
        if name in ("sum", "photometric") or name.startswith("silhouette"):
            axes.plot(values, color="black" if name == "sum" else None, label=name, linewidth=1.2)
    axes.set_ylim(bottom=0)
    axes.xaxis.get_major_locator().set_params(integer=True)
    axes.set(xlabel="iteration", title="cost")
    axes.grid(alpha=0.3)
    # Costs may stay high or fall to nothing, but hardly stay half-way.
    axes.legend(fontsize=7, loc="upper right")


def distance_course(view: CarView) -> NDArray[np.float64]:
    """Distance (N + 1,) of the footprint's middle from the true one, or without truth from the input's, metres."""
    true = view.footprints[0] if view.truth_corners_cam is None else footprint_of_corners(view.truth_corners_cam)
    return np.asarray(np.linalg.norm((view.footprints - true).mean(axis=1), axis=1))


def write_drift_figure(path: Path | str, full: CarView, silhouettes: CarView) -> None:
    """Write a car refined with all terms beside the same refined without photometry, as PNG."""
    figure = new_figure(*_DRIFT_INCHES, "drawing the drift")
    figure.suptitle(full.title)
    left, right = figure.subfigures(1, 2, width_ratios=[4, 1.1])
    axes = left.subplots(2, 4, width_ratios=[1.1, 1, 1, 1])
    views = dict(zip(_INKS, (silhouettes, full), strict=True))
    all_footprints = [box for v in views.values() for box in v.footprints[v.steps]]
    for row, (name, view) in zip(axes, views.items(), strict=True):
        _draw_from_above(row[0], name, view, all_footprints)
        _draw_contours(row[1:], view)
    _draw_legend(left, [*axes[0], *axes[1]])
    _draw_distances(right.subplots(), views)
    write_figure(path, figure)


def _draw_from_above(axes: Any, name: str, view: CarView, others: list[Any]) -> None:
    _show_from_above(axes, view, others)
    names = {view.steps[0]: "input", view.steps[-1]: "last iteration"}
    for number, ink in zip(view.steps, _step_inks(len(view.steps)), strict=True):
        _draw_footprint(axes, view.footprints[number], ink, names.get(number), linewidth=1.1)
    axes.set_title(name, fontsize=10, color=_INKS[name])


def _draw_contours(row: Any, view: CarView) -> None:
    inks = _step_inks(len(view.steps))
    last = len(inks) - 1
    # The first, an early and the last state: most is done in the first few steps.
    for axes, place in zip(row, (0, min(max(len(inks) // 4, 1), last), last), strict=True):
        title = f"iteration {view.steps[place]}"
        view.show(axes, "left", title)
        draw_lines(axes, view.mask_lines("left"), "white", "mask", linewidth=1.3, linestyle=":")
        draw_lines(axes, view.contours("left", view.steps[place]), inks[place], linewidth=1.8)


def _draw_legend(figure: Any, all_axes: list[Any]) -> None:
    """One for all panels below them: colours mean the same in each."""
    labelled = [pair for axes in all_axes for pair in zip(*axes.get_legend_handles_labels(), strict=True)]
    handles = {label: handle for handle, label in reversed(labelled)}
    names = [name for name in ("input", "last iteration", "ground truth", "mask") if name in handles]
    style = {"loc": "outside lower center", "fontsize": 9, "facecolor": "0.3", "labelcolor": "white"}
    figure.legend([handles[name] for name in names], names, ncols=len(names), **style)


def _draw_distances(axes: Any, views: dict[str, CarView]) -> None:
    for name, view in views.items():
        axes.plot(distance_course(view), color=_INKS[name], label=name)
    is_truth = next(iter(views.values())).truth_corners_cam is not None
    axes.set(xlabel="iteration", ylabel=f"distance to the {'true' if is_truth else 'input'} centre [m]")
    axes.set_ylim(bottom=0)
    axes.xaxis.get_major_locator().set_params(integer=True)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)


def _step_inks(count: int) -> list[Any]:
    """Colours from dark (the first) to bright (the last)."""
    from matplotlib import colormaps

    return [tuple(colour) for colour in colormaps["plasma"](np.linspace(0.0, 0.92, max(count, 1)))]


def _draw_footprint(axes: Any, corners: NDArray[np.float64], ink: Any, label: str | None = None, **style: Any) -> None:
    """A box seen from above, (4, 2) with the front first, and a stroke from its middle to its front."""
    closed = np.concatenate([corners, corners[:1]])
    axes.plot(closed[:, 0], closed[:, 1], color=ink, label=label, **style)
    stroke = np.stack([corners.mean(axis=0), corners[:2].mean(axis=0)])
    axes.plot(stroke[:, 0], stroke[:, 1], color=ink, **style)


def _show_from_above(axes: Any, view: CarView, others: Iterable[NDArray[np.float64]]) -> None:
    """Ground around a car, with the true box where it is known; other footprints (4, 2) must fit in."""
    shown = [*view.footprints[[0, -1]], footprint_of_corners(view.detector_corners_cam), *others]
    if view.truth_corners_cam is not None:
        shown.append(footprint_of_corners(view.truth_corners_cam))
        _draw_footprint(axes, shown[-1], "limegreen", "ground truth", linewidth=2.5)
    corners = np.concatenate(shown)
    middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
    half = np.ptp(corners, axis=0).max() / 2 + _BIRDS_EYE_MARGIN_M
    axes.set_aspect("equal")
    axes.set(xlim=middle[0] + np.array([-half, half]), ylim=middle[1] + np.array([-half, half]))
    axes.set(xlabel="x [m]", ylabel="z [m]")
    axes.grid(alpha=0.3)
