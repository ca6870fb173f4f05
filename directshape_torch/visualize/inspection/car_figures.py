"""All figures of one car into a folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from directshape_torch.visualize.inspection.car_view import CarView
from directshape_torch.visualize.inspection.course_figures import (
    write_contour_figure,
    write_cost_figure,
    write_drift_figure,
    write_iteration_animation,
)
from directshape_torch.visualize.inspection.point_figures import write_known_point_figure, write_point_figure
from directshape_torch.visualize.inspection.residual_figure import write_residual_figure
from directshape_torch.visualize.inspection.sampling_figure import write_occlusion_picture, write_sampling_figure
from directshape_torch.visualize.inspection.shape_figure import write_shape_figure

_OF_ONE_VIEW: dict[str, Callable[[Path, CarView], None]] = {
    "sampling.png": write_sampling_figure,
    "occlusion.png": write_occlusion_picture,
    "residuals.png": write_residual_figure,
    "iterations.png": write_contour_figure,
    "iterations.gif": write_iteration_animation,
    "costs.png": write_cost_figure,
    "shape.png": write_shape_figure,
    "points.png": write_point_figure,
}


def write_car_figures(folder: Path, view: CarView, silhouettes: CarView | None = None) -> list[Path]:
    """Write every figure that the car has data for; returns their paths.

    Args:
        folder: made where it is missing.
        view: the car.
        silhouettes: the same car refined without photometry, for the drift, or None.

    Raises:
        MissingDependencyError: matplotlib or Pillow is not installed.
    """
    figures = dict(_OF_ONE_VIEW)
    if silhouettes is not None:
        figures["drift.png"] = lambda path, full: write_drift_figure(path, full, silhouettes)
    if view.known_points is not None:
        figures["scan.png"] = write_known_point_figure
    for name, write in figures.items():
        write(folder / name, view)
    return [folder / name for name in figures]
