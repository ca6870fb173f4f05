"""This module makes the parts of the page for one frame: pictures of cars, residual maps, and a 3D scene."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from directshape_torch.config import RefinerConfig
from directshape_torch.io.result_files import ShapeArrays
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.visualize.drawing import View, draw_box, draw_contour
from directshape_torch.visualize.drawn_car import DrawnCar
from directshape_torch.visualize.page_parts import FRAME_QUALITY, data_url, mesh_data, numbers
from directshape_torch.visualize.residuals import draw_residuals, residual_maps
from directshape_torch.visualize.run_frames import RunFrame

_THUMBNAIL_PX = (360, 240)


def frame_details(frame: RunFrame, config: RefinerConfig) -> dict[str, Any]:
    """Parts of a frame by name, which the page parses on demand.

    They are pictures of each car; its residual maps, costs and disparity profile; and the 3D scene.
    """
    shapes, before, after = frame.result.shapes, frame.before, frame.after
    cars = [{"after": now} if before is None else {"before": before[k], "after": now} for k, now in enumerate(after)]
    view = None if frame.loaded is None else View.of_frame(frame.loaded.frame)
    parts = [_part(view, states) for states in cars]
    maps = _maps(parts, frame, config, cars)
    return {
        "thumbnails": [_thumbnails(part, states) for part, states in zip(parts, cars, strict=True)],
        "maps": [{**_figures(shapes, car), "pictures": pictures} for car, pictures in enumerate(maps)],
        "scene": {
            **_background(view, frame.loaded),
            "ground_source": shapes.ground_source,
            "truth": [numbers(corners.reshape(-1), 3) for corners in frame.truth_corners_cam],
            "cars": [_car(states.get("before"), states["after"]) for states in cars],
        },
    }


def _part(view: View | None, states: dict[str, DrawnCar]) -> View | None:
    """The part of the image that shows a car in all of its states, or None if it is not visible."""
    corners_cam = np.concatenate([state.corners_cam for state in states.values()])
    return None if view is None else view.around(corners_cam, _THUMBNAIL_PX)


def _thumbnails(part: View | None, states: dict[str, DrawnCar]) -> dict[str, str]:
    """Pictures of a car before and after; the result is empty if the image does not show the car."""
    pictures: dict[str, str] = {}
    if part is None:
        return pictures
    for name, state in states.items():
        view = part.copy()
        if state.surface is None:
            draw_box(view, state.corners_cam, state.colour, state.is_front_known)
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
    frame: RunFrame,
    config: RefinerConfig,
    cars: Sequence[dict[str, DrawnCar]],
) -> list[dict[str, str]]:
    """Residual maps of each car by names such as "photometric_before", if images, masks and shapes are available."""
    pictures: list[dict[str, str]] = [{} for _ in cars]
    rows = [row for row, states in enumerate(cars) if states["after"].is_refined and parts[row] is not None]
    if frame.loaded is None or frame.inputs.prior is None or not rows:
        return pictures
    names, of_names = list(cars[rows[0]]), []
    for name in names:
        states = [cars[row][name] for row in rows]
        of_names.append((np.stack([car.T_cam_obj for car in states]), np.stack([car.code for car in states])))
    maps = residual_maps(frame.loaded, frame.inputs.prior, config, torch.tensor(rows), of_names)
    for name, found in zip(names, maps, strict=True):
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
    """Pose, boxes and mesh of a car; the mesh is None for the mean shape, which the page has once."""
    mesh = None if before is not None and after.mesh is before.mesh else after.mesh
    return {
        "T_cam_obj": numbers(after.T_cam_obj.reshape(-1), 5),
        "box_before": None if before is None else numbers(before.corners_cam.reshape(-1), 3),
        "box_after": numbers(after.corners_cam.reshape(-1), 3),
        "mesh": None if mesh is None else mesh_data(mesh.vertices, mesh.faces),
    }
