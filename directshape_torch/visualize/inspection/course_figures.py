"""The course of a refinement: contour, box and costs of every state as an animation, the drift without photometry."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from directshape_torch.io.figure_files import figure_picture, new_figure, write_animation, write_figure
from directshape_torch.io.instance_masks import SIDES
from directshape_torch.visualize.drawing import Picture
from directshape_torch.visualize.inspection.car_view import CarView, draw_lines, footprint_of_corners


def costs_of_car(view: CarView) -> dict[str, NDArray[np.float64]]:
    """Cost (N + 1,) of each term by its name, at the final stage's settings, and their "sum"."""
    costs = view.trace.costs[:, view.car].cpu().numpy()
    named = dict(zip(view.trace.result.term_names, costs.T, strict=True))
    return {**named, "sum": costs.sum(axis=1)}


_BIRDS_EYE_MARGIN_M = 0.7
_ANIMATION_INCHES = (13.5, 3.3)
_SECONDS_A_STEP, _SECONDS_AT_END = 0.35, 2.5


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


_DRIFT_INCHES = (14.5, 5.6)
_INKS = {"silhouettes alone": "crimson", "all terms": "royalblue"}


def distance_course(view: CarView) -> NDArray[np.float64]:
    """How far the middle of the car's footprint lies from the true one after each iteration, metres.

    From the input's own, where there is no truth.
    """
    true = view.footprints[0] if view.truth_corners_cam is None else footprint_of_corners(view.truth_corners_cam)
    return np.asarray(np.linalg.norm((view.footprints - true).mean(axis=1), axis=1))


def write_drift_figure(path: Path | str, full: CarView, silhouettes: CarView) -> None:
    """Write a car refined with all terms beside the same refined without photometry, as PNG.

    A row each, seen from above, then the contours of three states; then the distances.
    """
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
    figure.legend(
        [handles[name] for name in names],
        names,
        loc="outside lower center",
        ncols=len(names),
        fontsize=9,
        facecolor="0.3",
        labelcolor="white",
    )


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
