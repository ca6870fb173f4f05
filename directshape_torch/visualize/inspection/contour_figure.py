"""The projected contour of every iteration in the image, beside the same states seen from above."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from directshape_torch.io.figure_files import new_figure
from directshape_torch.visualize.inspection.car_view import CarView, footprint_of_corners
from directshape_torch.visualize.inspection.panels import (
    DETECTOR_INK,
    MASK_INK,
    draw_footprint,
    draw_lines,
    iteration_inks,
    show_birds_eye,
    show_crop,
    write_figure,
)

_SIZE_INCHES = (11.5, 4.6)


def write_contour_figure(path: Path | str, view: CarView) -> None:
    """Write the figure as PNG: the instance mask is the dotted line, the colour tells the iteration.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    figure = new_figure(*_SIZE_INCHES, "drawing iterations")
    figure.suptitle(view.title)
    image, above = figure.subplots(1, 2, width_ratios=[3, 2])
    inks = iteration_inks(len(view.steps))
    show_crop(image, view.image("left"), view.window("left"), f"projected contour of {len(view.steps)} states")
    draw_lines(image, view.mask_lines("left"), MASK_INK, "mask", linewidth=1.3, linestyle=":")
    show_birds_eye(above, view, [view.footprint(k) for k in view.steps])
    detector = footprint_of_corners(view.detector_corners_cam)
    draw_footprint(above, detector, DETECTOR_INK, "detection", linewidth=1.2, linestyle="--")
    for place, number in enumerate(view.steps):
        width = 1.8 if place in (0, len(view.steps) - 1) else 0.8
        draw_lines(image, view.contours("left", number), inks[place], linewidth=width)
        draw_footprint(above, view.footprint(number), inks[place], linewidth=width)
    _add_iteration_bar(figure, above, view.steps)
    image.legend(loc="lower left", fontsize=8, facecolor="0.3", labelcolor="white")
    above.legend(loc="upper left", fontsize=8)
    write_figure(path, figure)


def _add_iteration_bar(figure: Any, axes: Any, steps: list[int]) -> None:
    """A bar of the colours that the states have, with the iterations that they come from."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import BoundaryNorm, ListedColormap

    edges = [k - 0.5 for k in range(len(steps) + 1)]
    colours = ScalarMappable(BoundaryNorm(edges, len(steps)), ListedColormap(iteration_inks(len(steps))))
    bar = figure.colorbar(colours, ax=axes, label="iteration", ticks=range(len(steps)))
    bar.set_ticklabels([str(k) for k in steps], fontsize=7)
