"""What the page shows of one frame beside its rows: pictures of cars, residual maps, and a 3D scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from directshape_torch.config import RefinerConfig
from directshape_torch.io.kitti_labels import KittiObject
from directshape_torch.io.result_files import ShapeArrays
from directshape_torch.io.run_folder import FrameResult
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.report.page_parts import FRAME_QUALITY, data_url, mesh_data, numbers
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.visualize.drawing import Surface, View, draw_box, draw_contour
from directshape_torch.visualize.drawn_car import DrawnCar, cars_after, cars_before, corners_cam, true_corners
from directshape_torch.visualize.residuals import ResidualMaps, draw_residuals

_THUMBNAIL_PX = (360, 240)


@dataclass(frozen=True)
class FrameMaterial:
    """One frame as far as it is known."""

    result: FrameResult  # what the run left
    loaded: LoadedFrame | None  # what went in
    detections: list[KittiObject] | None  # the lines of its cars in the detection file
    labels: list[KittiObject] | None  # the truth


@dataclass(frozen=True)
class DetailSettings:
    """What all frames share."""

    classes: Sequence[str]  # refined types
    prior: ShapePrior | None  # shapes, or None where those of the run are not at hand
    mean: Surface | None  # the mean one
    config: RefinerConfig  # of the run


def frame_details(material: FrameMaterial, settings: DetailSettings) -> dict[str, Any]:
    """Parts by name, each parsed by the page when it is first needed: pictures of each car; its residual maps, costs
    and disparity profile; and the 3D scene."""
    shapes, t_cam_ref = material.result.shapes, _t_cam_ref(material.result.shapes)
    before = None
    if material.detections is not None:
        before = cars_before(material.detections, t_cam_ref, settings.mean, shapes.codes.shape[1])
    after = _cars_after(material.result, t_cam_ref, before, settings.prior)
    cars = [{"after": now} if before is None else {"before": before[k], "after": now} for k, now in enumerate(after)]
    view = None if material.loaded is None else View.of_frame(material.loaded.frame)
    parts = [_part(view, states) for states in cars]
    maps = _maps(parts, material.loaded, settings, cars)
    return {
        "thumbnails": [_thumbnails(part, states) for part, states in zip(parts, cars, strict=True)],
        "maps": [{**_figures(shapes, car), "pictures": pictures} for car, pictures in enumerate(maps)],
        "scene": {
            **_background(view, material.loaded),
            "ground_source": shapes.ground_source,
            "truth": [
                numbers(corners.reshape(-1), 3)
                for corners in true_corners(material.labels, settings.classes, t_cam_ref)
            ],
            "cars": [_car(states.get("before"), states["after"]) for states in cars],
        },
    }


def _cars_after(
    result: FrameResult, t_cam_ref: Tensor, before: Sequence[DrawnCar] | None, prior: ShapePrior | None
) -> list[DrawnCar]:
    shapes = result.shapes
    location_ref, rotation_y, hwl = (
        torch.from_numpy(x) for x in (shapes.boxes_location_ref, shapes.boxes_rotation_y, shapes.boxes_hwl)
    )
    lines, corners = shapes.input_lines.tolist(), corners_cam(location_ref, rotation_y, hwl, t_cam_ref)
    states = (lines, shapes.statuses, shapes.T_cam_obj, shapes.codes, corners)
    return cars_after(*states, before, prior, result.mesh_files)


def _t_cam_ref(shapes: ShapeArrays) -> Tensor:
    """`x_cam = x_ref + t_cam_ref` (3,), float64, from the states themselves; zero for a frame without cars."""
    if not len(shapes.input_lines):
        return torch.zeros(3, dtype=torch.float64)
    offset = shapes.T_cam_obj.astype(np.float64)[:, :3, 3] - shapes.T_ref_obj.astype(np.float64)[:, :3, 3]
    return torch.from_numpy(np.median(offset, axis=0))


def _part(view: View | None, states: dict[str, DrawnCar]) -> View | None:
    """The part of the image that shows a car in all of its states, or None where it shows none."""
    corners_cam = np.concatenate([state.corners_cam for state in states.values()])
    return None if view is None else view.around(corners_cam, _THUMBNAIL_PX)


def _thumbnails(part: View | None, states: dict[str, DrawnCar]) -> dict[str, str]:
    """Nothing for a car that the image does not show."""
    pictures: dict[str, str] = {}
    if part is None:
        return pictures
    for name, state in states.items():
        view = part.copy()
        if state.surface is None:
            draw_box(view, state.corners_cam, state.colour)
        else:
            draw_contour(view, state.surface, state.colour, 2)
        pictures[name] = data_url(view.picture)
    return pictures


def _figures(shapes: ShapeArrays, car: int) -> dict[str, Any]:
    return {
        "message": shapes.messages[car],
        "terms": list(shapes.term_names),
        "costs_before": numbers(shapes.costs_before[car]),
        "costs_after": numbers(shapes.costs_after[car]),
        "profile_offsets_px": numbers(shapes.profile_offsets_px),
        "profile_before": numbers(shapes.profile_costs_before[car]),
        "profile_after": numbers(shapes.profile_costs_after[car]),
        "sigmas_ref": numbers(shapes.sigmas_ref[car]),
    }


def _maps(
    parts: Sequence[View | None],
    loaded: LoadedFrame | None,
    settings: DetailSettings,
    cars: Sequence[dict[str, DrawnCar]],
) -> list[dict[str, str]]:
    """Maps of each car by the names "photometric_before" and so on, where images, masks and shapes are at hand."""
    pictures: list[dict[str, str]] = [{} for _ in cars]
    rows = [row for row, states in enumerate(cars) if states["after"].is_refined and parts[row] is not None]
    if loaded is None or settings.prior is None or not rows:
        return pictures
    maps = ResidualMaps(loaded, settings.prior, settings.config, torch.tensor(rows))
    for name in cars[rows[0]]:
        states = [cars[row][name] for row in rows]
        found = maps.of(np.stack([car.T_cam_obj for car in states]), np.stack([car.code for car in states]))
        for row, residuals in zip(rows, found, strict=True):
            for kind, key in (("photometric", "photometric"), ("silhouette_left", "silhouette")):
                part = parts[row]
                if part is not None and len(getattr(residuals, kind).uv):
                    view = part.copy()
                    draw_residuals(view, residuals, kind)
                    pictures[row][f"{key}_{name}"] = data_url(view.picture)
    return pictures


def _background(view: View | None, loaded: LoadedFrame | None) -> dict[str, Any]:
    """The image with its camera, and the ground, in the left camera frame."""
    if view is None or loaded is None:
        return dict.fromkeys(("image", "size_wh", "K", "ground"))
    ground = loaded.frame.ground
    return {
        "image": data_url(view.picture, FRAME_QUALITY),
        "size_wh": [view.picture.shape[1], view.picture.shape[0]],
        "K": numbers(view.K.reshape(-1), 3),
        "ground": numbers([*ground.normal[0].tolist(), float(ground.offset[0])], 6),
    }


def _car(before: DrawnCar | None, after: DrawnCar) -> dict[str, Any]:
    """Pose, boxes and mesh of a car; None for the mean shape, which the page has once."""
    mesh = None if before is not None and after.mesh is before.mesh else after.mesh
    return {
        "T_cam_obj": numbers(after.T_cam_obj.reshape(-1), 5),
        "box_before": None if before is None else numbers(before.corners_cam.reshape(-1), 3),
        "box_after": numbers(after.corners_cam.reshape(-1), 3),
        "mesh": None if mesh is None else mesh_data(mesh.vertices, mesh.faces),
    }
