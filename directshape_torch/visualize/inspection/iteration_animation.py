"""The iterations of one car as an animated GIF."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from directshape_torch.io.figure_files import figure_picture, new_figure, write_animation
from directshape_torch.io.instance_masks import SIDES
from directshape_torch.visualize.drawing import Picture
from directshape_torch.visualize.inspection.car_view import CarView
from directshape_torch.visualize.inspection.cost_figure import costs_of_car
from directshape_torch.visualize.inspection.panels import (
    MASK_INK,
    draw_footprint,
    draw_lines,
    iteration_inks,
    show_birds_eye,
    show_crop,
)

_SIZE_INCHES = (13.5, 3.3)
_SECONDS_A_STEP, _SECONDS_AT_END = 0.35, 2.5


def write_iteration_animation(path: Path | str, view: CarView) -> None:
    """Write the GIF: contour in both images, box from above, and costs, for every state that the car moved to.

    Raises:
        MissingDependencyError: matplotlib or Pillow is not installed.
    """
    frames = animation_frames(view)
    seconds = [_SECONDS_A_STEP] * (len(frames) - 1) + [_SECONDS_AT_END]
    write_animation(path, frames, seconds)


def animation_frames(view: CarView) -> list[Picture]:
    """One picture (h, w, 3) for each of `view.steps`."""
    figure = new_figure(*_SIZE_INCHES, "drawing an animation")
    panels = figure.subplots(1, 4, width_ratios=[2.7, 2.7, 1.9, 1.7])
    *images, above, costs = panels
    for axes, side in zip(images, SIDES, strict=True):
        show_crop(axes, view.image(side), view.window(side), side)
        draw_lines(axes, view.mask_lines(side), MASK_INK, linewidth=1.2, linestyle=":")
    figure.suptitle(view.title, fontsize=9)
    show_birds_eye(above, view, [view.footprint(k) for k in view.steps])
    _draw_costs(costs, view)
    # The parts find their places once: they would dance if every picture were laid out anew.
    figure_picture(figure)
    figure.set_layout_engine("none")
    return [_frame(figure, panels, view, place) for place in range(len(view.steps))]


def _frame(figure: Any, panels: Sequence[Any], view: CarView, place: int) -> Picture:
    inks, number = iteration_inks(len(view.steps)), view.steps[place]
    known = [(axes, len(axes.lines)) for axes in panels]
    *images, above, costs = panels
    figure.suptitle(f"{view.title}, iteration {number}", fontsize=9)
    for axes, side in zip(images, SIDES, strict=True):
        draw_lines(axes, view.contours(side, number), inks[place], linewidth=2.0)
    for earlier in range(place):
        draw_footprint(above, view.footprint(view.steps[earlier]), inks[earlier], linewidth=0.5)
    draw_footprint(above, view.footprint(number), inks[place], linewidth=2.0)
    costs.axvline(number, color="crimson", linewidth=1.0)
    picture = figure_picture(figure)
    for axes, count in known:
        for line in list(axes.lines)[count:]:
            line.remove()
    return picture


def _draw_costs(axes: Any, view: CarView) -> None:
    for name, values in costs_of_car(view).items():
        if name in ("sum", "photometric") or name.startswith("silhouette"):
            axes.plot(values, color="black" if name == "sum" else None, label=name, linewidth=1.2)
    axes.set_ylim(bottom=0)
    axes.xaxis.get_major_locator().set_params(integer=True)
    axes.set(xlabel="iteration", title="cost")
    axes.grid(alpha=0.3)
    # Costs may stay high or fall to nothing, but hardly stay half-way.
    axes.legend(fontsize=7, loc="center right")
