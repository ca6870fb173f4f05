"""All figures of one car into a folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from directshape_torch.io.atomic_files import write_png
from directshape_torch.visualize.inspection.car_view import CarView
from directshape_torch.visualize.inspection.contour_figure import write_contour_figure
from directshape_torch.visualize.inspection.cost_figure import write_cost_figure
from directshape_torch.visualize.inspection.drift_figure import write_drift_figure
from directshape_torch.visualize.inspection.iteration_animation import write_iteration_animation
from directshape_torch.visualize.inspection.known_point_figure import write_known_point_figure
from directshape_torch.visualize.inspection.point_figure import write_point_figure
from directshape_torch.visualize.inspection.residual_figure import write_residual_figure
from directshape_torch.visualize.inspection.shape_figure import write_shape_figure
from directshape_torch.visualize.observation_sheet import observation_sheet

_OF_ONE_VIEW: dict[str, Callable[[Path, CarView], None]] = {
    "residuals.png": write_residual_figure,
    "iterations.png": write_contour_figure,
    "costs.png": write_cost_figure,
    "shape.png": write_shape_figure,
    "points.png": write_point_figure,
    "iterations.gif": write_iteration_animation,
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
    written = []
    detections, sampling = view.loaded.detections, view.trace.problem.config.sampling
    if bool(detections.has_mask_left[view.car]):
        sheet = observation_sheet(view.loaded.frame, detections, view.car, sampling)
        folder.mkdir(parents=True, exist_ok=True)
        write_png(folder / "observation.png", sheet)
        written.append(folder / "observation.png")
    for name, write in _OF_ONE_VIEW.items():
        write(folder / name, view)
        written.append(folder / name)
    if silhouettes is not None:
        write_drift_figure(folder / "drift.png", view, silhouettes)
        written.append(folder / "drift.png")
    if view.known_points is not None:
        write_known_point_figure(folder / "scan.png", view)
        written.append(folder / "scan.png")
    return written
