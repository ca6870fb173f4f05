"""Scan points over the image and from above, with the car before and after (paper: LiDAR is for display alone)."""

from __future__ import annotations

from pathlib import Path

from directshape_torch.errors import InputError
from directshape_torch.io.figure_files import new_figure
from directshape_torch.visualize.inspection.car_view import CarView
from directshape_torch.visualize.inspection.panels import (
    AFTER_INK,
    BEFORE_INK,
    draw_footprint,
    draw_lines,
    show_birds_eye,
    show_crop,
    write_figure,
)

_SIZE_INCHES = (12.0, 4.6)
# Depth about the car that the colours tell apart.
_DEPTH_RANGE_M = 6.0


def write_known_point_figure(path: Path | str, view: CarView) -> None:
    """Write the figure as PNG: points coloured by depth over the image, and all of them from above.

    Raises:
        InputError: the view has no known points.
        MissingDependencyError: matplotlib is not installed.
    """
    points = view.known_points
    if points is None:
        raise InputError("view", "a car of a frame with a scan or another source of true points", "none")
    figure = new_figure(*_SIZE_INCHES, "drawing scan points")
    figure.suptitle(f"{view.title}; {points.name}, {int(points.of_car.sum())} points on the car")
    image, above = figure.subplots(1, 2, width_ratios=[3, 2])
    u0, v0, u1, v1 = window = view.window("left")
    show_crop(image, view.image("left"), window, dimmed=True)
    inside = ((points.uv >= (u0, v0)) & (points.uv < (u1, v1))).all(axis=1)
    depth = float(view.centre_cam(len(view.trace) - 1)[1])
    limits = {"vmin": depth - _DEPTH_RANGE_M / 2, "vmax": depth + _DEPTH_RANGE_M / 2}
    dots = image.scatter(*points.uv[inside].T, c=points.points_cam[inside, 2], s=6, cmap="turbo", **limits)
    figure.colorbar(dots, ax=image, label="depth [m]", extend="both", shrink=0.8)
    show_birds_eye(above, view)
    for number, name, ink in ((0, "before", BEFORE_INK), (len(view.trace) - 1, "after", AFTER_INK)):
        draw_lines(image, view.contours("left", number), ink, name, linewidth=1.5)
        draw_footprint(above, view.footprint(number), ink, name, linewidth=1.5)
    image.legend(loc="lower left", fontsize=8)
    above.legend(loc="upper left", fontsize=8)
    write_figure(path, figure)
