"""Points on a car: by dense stereo, of the refined shape, true ones (paper, point clouds); a scan over the image."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from directshape_torch.config import PointCloudConfig
from directshape_torch.errors import InputError
from directshape_torch.geometry.camera import rays_from_pixels
from directshape_torch.io.figure_files import new_figure, write_figure
from directshape_torch.observation.car_points import car_points
from directshape_torch.scene import Detections, FrameBatch
from directshape_torch.stereo_matching.disparity import with_disparity
from directshape_torch.visualize.inspection.car_view import CarView
from directshape_torch.visualize.inspection.panels import (
    AFTER_INK,
    BEFORE_INK,
    draw_footprint,
    draw_lines,
    show_birds_eye,
    show_crop,
)
from directshape_torch.visualize.inspection.shape_figure import COLOURS, distance_at, distance_scale

Array = NDArray[np.float64]

_PANEL_INCHES = (3.7, 4.4)
_LIMIT_M = 0.3
_ROOM_M = 0.9
_MOST_POINTS = 20_000
_OURS = "refined shape"


class PointSet(NamedTuple):
    """Points of a car with a name, in its refined object frame."""

    name: str
    points_obj: Array  # (P, 3) metres
    distance_m: Array  # (P,) signed distance to the refined shape; NaN outside of the region where that is known


def point_sets(view: CarView) -> list[PointSet]:
    """Dense stereo, the refined shape under the pixels of the car's mask, and known points: those that there are."""
    clouds = [] if view.stereo_points_cam is None else [("dense stereo", view.stereo_points_cam)]
    clouds.append((_OURS, shape_points_cam(view)))
    if view.known_points is not None:
        points = view.known_points
        clouds.append((points.name, points.points_cam[points.of_car]))
    return [_point_set(view, name, points_cam) for name, points_cam in clouds]


def stereo_points(frame: FrameBatch, detections: Detections, config: PointCloudConfig) -> list[Array]:
    """Points (P, 3) of every car by the matcher that the settings name, or by the disparity that the frame brings.

    Raises:
        MissingDependencyError: the matcher is not installed.
    """
    settings = replace(config, max_points=_MOST_POINTS)
    points = car_points(with_disparity(frame, settings.matcher), detections, settings)
    points_cam, car = points.points_cam.double().cpu().numpy(), points.object_index.cpu().numpy()
    return [points_cam[car == number] for number in range(len(detections))]


def shape_points_cam(view: CarView) -> Array:
    """(P, 3) where the pixels of the car's left mask see the refined shape."""
    grid, seen = view.seen("left", len(view.trace) - 1)
    uv = grid.uv(view.loaded.frame.images_left).cpu()
    depth = seen.depth.cpu()
    u, v = uv.round().long().unbind(1)
    mask = view.loaded.detections.mask_left[view.car].cpu()
    height, width = mask.shape
    wanted = depth.isfinite() & (mask[v.clamp_max(height - 1), u.clamp_max(width - 1)] > 0.5)
    rays = rays_from_pixels(uv, view.loaded.frame.camera.K_left[0].cpu())
    return np.asarray((depth[:, None] * rays)[wanted].double())


def write_point_figure(path: Path | str, view: CarView) -> None:
    """Write the figure as PNG: from the side and from above, in the car's refined frame, front to the right.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    sets = point_sets(view)
    figure = new_figure(_PANEL_INCHES[0] * len(sets) + 0.5, _PANEL_INCHES[1], "drawing point clouds")
    figure.suptitle(view.title)
    axes = figure.subplots(2, len(sets), squeeze=False, sharex="row", sharey="row")
    values = view.prior.values(view.state(len(view.trace) - 1).code)[0]
    origin, spacing = view.prior.origin.double().cpu().numpy(), view.prior.spacing_m
    for column, points in enumerate(sets):
        axes[0, column].set_title(f"{points.name}: {len(points.points_obj)} points", fontsize=9)
        # The least value across an axis is below zero where the shape is seen along it.
        for row, (across, vertical) in enumerate(((2, 1), (1, 2))):
            outline = values.amin(dim=across).double().cpu().numpy()
            places = [origin[k] + spacing * np.arange(n) for k, n in zip((0, vertical), outline.shape, strict=True)]
            axes[row, column].contour(*places, outline.T, levels=[0.0], colors=["black"], linewidths=1.0)
            _scatter(axes[row, column], points, vertical)
            _frame(axes[row, column], places, vertical, column == 0)
    if len(sets) > 1:
        scale = distance_scale(_LIMIT_M)
        figure.colorbar(scale, ax=axes, label="signed distance to the refined shape [m]", shrink=0.8, extend="both")
    write_figure(path, figure)


def _point_set(view: CarView, name: str, points_cam: Array) -> PointSet:
    state = view.state(len(view.trace) - 1)
    T_obj_cam = state.T_obj_cam[0].double().cpu().numpy()
    points_obj = points_cam @ T_obj_cam[:3, :3].T + T_obj_cam[:3, 3]
    low, high = view.prior.bounds_obj.double().cpu().numpy()
    distance = distance_at(view.prior, view.prior.values(state.code)[0], points_obj)
    within = ((points_obj >= low) & (points_obj <= high)).all(axis=1)
    return PointSet(name, points_obj, np.where(within, distance, np.nan))


def _scatter(axes: Any, points: PointSet, vertical: int) -> None:
    away = np.isnan(points.distance_m)
    p = points.points_obj
    axes.plot(p[away, 0], p[away, vertical], ".", color="0.7", markersize=1.5)
    size = float(np.clip(9000 / max(len(p), 1), 1.0, 9.0))
    if points.name == _OURS:
        axes.plot(p[:, 0], p[:, vertical], ".", color=AFTER_INK, markersize=size**0.5)
        return
    c, limits = points.distance_m[~away], {"vmin": -_LIMIT_M, "vmax": _LIMIT_M}
    axes.scatter(p[~away, 0], p[~away, vertical], c=c, s=size, cmap=COLOURS, **limits)


def _frame(axes: Any, places: list[Array], vertical: int, is_first: bool) -> None:
    # Points far behind the car would make it a speck: they lie beyond the frame.
    (x0, *_, x1), (low, *_, high) = places
    axes.set(xlim=(x0 - _ROOM_M, x1 + _ROOM_M), aspect="equal", xlabel="x, forward [m]")
    axes.set_ylim((high + 0.2, low - 0.2) if vertical == 1 else (low - _ROOM_M, high + _ROOM_M))
    if is_first:
        axes.set_ylabel("y, down [m]" if vertical == 1 else "z, left [m]")
    axes.set_facecolor("0.93")
    axes.grid(alpha=0.4)


_SCAN_INCHES = (12.0, 4.6)
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
    figure = new_figure(*_SCAN_INCHES, "drawing scan points")
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
