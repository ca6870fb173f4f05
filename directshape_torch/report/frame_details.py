"""What the page shows of one frame beside its rows: pictures of cars, residual maps, and a 3D scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from directshape_torch.config import RefinerConfig
from directshape_torch.io.kitti_labels import KittiObject
from directshape_torch.io.result_files import ShapeArrays
from directshape_torch.io.run_folder import FrameResult
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.observation.occlusion import occlusion_map
from directshape_torch.report.page_parts import FRAME_QUALITY, data_url, mesh_data, numbers
from directshape_torch.report.residual_maps import photometric_picture, residual_maps, silhouette_picture
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.visualize.drawing import (
    ORANGE,
    Surface,
    View,
    Window,
    draw_box,
    draw_contour,
    window_around,
)
from directshape_torch.visualize.drawn_car import DrawnCar, cars_after, cars_before, corners_cam, true_corners

_WIDTH_PX = 260
_LARGEST_SCALE = 4.0
_LEAST_ASPECT = 1.2


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
    windows = [None if view is None else _window(view, list(states.values())) for states in cars]
    return {
        "thumbnails": [_thumbnails(view, window, states) for window, states in zip(windows, cars, strict=True)],
        "maps": [
            {**_figures(shapes, car), "pictures": _maps(view, material.loaded, settings, car, window, states)}
            for car, (window, states) in enumerate(zip(windows, cars, strict=True))
        ],
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


def _window(view: View, states: Sequence[DrawnCar]) -> Window | None:
    """The part of the image that shows a car in all of its states, or None where it shows none."""
    bounds = view.bounds(np.concatenate([state.corners_cam for state in states]))
    if bounds is None:
        return None
    tall = 1.2 * (bounds[3] - bounds[1]) + 1
    u0, v0, u1, v1 = window_around(bounds, max(1.2 * (bounds[2] - bounds[0]) + 4, _LEAST_ASPECT * tall), tall)
    height, width = view.picture.shape[:2]
    return max(u0, 0), max(v0, 0), min(u1, width), min(v1, height)


def _thumbnails(view: View | None, window: Window | None, states: dict[str, DrawnCar]) -> dict[str, str]:
    """Nothing for a car that the image does not show."""
    if view is None or window is None:
        return {}
    pictures = {}
    for name, state in states.items():
        part = view.part(window, min(_WIDTH_PX / (window[2] - window[0]), _LARGEST_SCALE))
        colour, surface = ORANGE if name == "before" else state.colour, state.surface
        if surface is None:
            draw_box(part, state.corners_cam, colour)
        else:
            draw_contour(part, surface, colour, 2)
        pictures[name] = data_url(part.picture)
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
    view: View | None,
    loaded: LoadedFrame | None,
    settings: DetailSettings,
    car: int,
    window: Window | None,
    states: dict[str, DrawnCar],
) -> dict[str, str]:
    """Maps by the names "photometric_before" and so on, where images and shapes are at hand."""
    if view is None or loaded is None or settings.prior is None or window is None:
        return {}
    detections, config = loaded.detections, settings.config
    foreground = detections.mask_left[car].float().numpy() if bool(detections.has_mask_left[car]) else None
    hidden = _hidden(loaded, car, window, config)
    pictures = {}
    for name, state in states.items():
        photometric, silhouette = residual_maps(
            loaded.frame, settings.prior, state.T_cam_obj, state.code, window, foreground, hidden, config
        )
        pictures[f"photometric_{name}"] = data_url(photometric_picture(view.picture, window, photometric))
        if silhouette is not None:
            pictures[f"silhouette_{name}"] = data_url(silhouette_picture(view.picture, window, silhouette))
    return pictures


def _hidden(loaded: LoadedFrame, car: int, window: Window, config: RefinerConfig) -> npt.NDArray[np.bool_]:
    """(H, W), true where an instance in front of the car covers a pixel of the window."""
    u0, v0, u1, v1 = window
    hidden = torch.zeros(loaded.detections.mask_left.shape[1:], dtype=torch.bool)
    occluders = occlusion_map(loaded.detections, "left", config.sampling.occlusion_order)
    hidden[v0:v1, u0:u1] = occluders.window(car, window)
    return np.asarray(hidden.numpy())


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
