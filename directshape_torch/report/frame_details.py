"""Everything of one frame that the page shows on demand: thumbnails, residual maps, picture and 3D scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from directshape_torch.io.kitti_labels import KittiObject
from directshape_torch.io.result_files import ShapeArrays
from directshape_torch.io.run_folder import FrameResult
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.observation.occlusion import OcclusionOrder, occlusion_map
from directshape_torch.report.car_rows import is_refined
from directshape_torch.report.drawn_cars import (
    CarState,
    DrawnCars,
    ObjectMesh,
    frame_t_cam_ref,
    states_after,
    states_before,
    true_corners,
    window_of_states,
)
from directshape_torch.report.page_data import FRAME_QUALITY, data_url, mesh_data, numbers
from directshape_torch.report.residual_maps import (
    MapSettings,
    ViewedPair,
    Window,
    photometric_picture,
    residual_maps,
    silhouette_picture,
)
from directshape_torch.scene import Detections
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.visualize.drawing import (
    BLUE,
    GREY,
    ORANGE,
    Colour,
    Picture,
    View,
    draw_box,
    draw_contour,
    picture_of,
)

_WIDTH_PX = 260
_LARGEST_SCALE = 4.0


@dataclass(frozen=True)
class FrameMaterial:
    """One frame as far as it is known.

    Attributes:
        result: what the run left.
        loaded: what went in, or None.
        detections: the lines of its cars in the detection file, or None.
        labels: the truth, or None.
    """

    result: FrameResult
    loaded: LoadedFrame | None
    detections: list[KittiObject] | None
    labels: list[KittiObject] | None


@dataclass(frozen=True)
class DetailSettings:
    """What all frames share.

    Attributes:
        classes: refined types.
        prior: shapes, or None where those of the run are not at hand.
        mean: the mesh of its mean shape.
        maps: settings of residual maps.
        occlusion_order: see `occlusion_map`.
    """

    classes: Sequence[str]
    prior: ShapePrior | None
    mean: ObjectMesh | None
    maps: MapSettings
    occlusion_order: OcclusionOrder


@dataclass(frozen=True)
class _View:
    """The left image of a frame."""

    image: Picture
    K: npt.NDArray[np.float64]

    @classmethod
    def of_frame(cls, loaded: LoadedFrame) -> _View:
        frame = loaded.frame
        return cls(picture_of(frame.images_left[0]), frame.camera.K_left[0].double().numpy())


def frame_details(material: FrameMaterial, settings: DetailSettings) -> dict[str, Any]:
    """Three parts by name, each parsed by the page when it is first needed.

    `thumbnails`: for each car its pictures "before" and "after". `maps`: for each car its residual maps, costs by term
    and disparity profile. `scene`: image, camera, ground, boxes and meshes.
    """
    cars, loaded = _drawn_cars(material, settings), material.loaded
    view = None if loaded is None else _View.of_frame(loaded)
    return {
        "thumbnails": _thumbnails(view, cars, material.result),
        "maps": _car_maps(view, material, settings, cars),
        "scene": _scene(view, loaded, cars, material.result.shapes.ground_source),
    }


def _drawn_cars(material: FrameMaterial, settings: DetailSettings) -> DrawnCars:
    result = material.result
    t_cam_ref = frame_t_cam_ref(result)
    before = None
    if material.detections is not None:
        before = states_before(material.detections, t_cam_ref, result.shapes.codes.shape[1], settings.mean)
    truth = [] if material.labels is None else true_corners(material.labels, settings.classes, t_cam_ref)
    return DrawnCars(before, states_after(result, before, settings.prior), truth)


def _thumbnails(view: _View | None, cars: DrawnCars, result: FrameResult) -> list[dict[str, str]]:
    """Nothing for a car that the image does not show."""
    pictures: list[dict[str, str]] = []
    for car, status in enumerate(result.shapes.statuses):
        states = cars.states(car)
        window = None if view is None else window_of_states(view.image, view.K, list(states.values()))
        colours = {"before": ORANGE, "after": BLUE if is_refined(status) else GREY}
        pictures.append(
            {
                name: data_url(_thumbnail(view, window, state, colours[name]))
                for name, state in states.items()
                if view is not None and window is not None
            }
        )
    return pictures


def _thumbnail(view: _View, window: Window, state: CarState, colour: Colour) -> Picture:
    scale = min(_WIDTH_PX / (window[2] - window[0]), _LARGEST_SCALE)
    part = View.of_window(view.image, view.K, window, scale)
    surface = state.surface
    if surface is None:
        draw_box(part, state.corners_cam, colour)
    else:
        draw_contour(part, surface, colour, 2)
    return part.picture


def _car_maps(
    view: _View | None, material: FrameMaterial, settings: DetailSettings, cars: DrawnCars
) -> list[dict[str, Any]]:
    """For each car its costs, its profile, and where images are at hand its residual maps."""
    loaded, prior = material.loaded, settings.prior
    parts = [_figures(material.result.shapes, car) for car in range(len(cars.after))]
    if view is not None and loaded is not None and prior is not None:
        pair = ViewedPair.of_frame(loaded.frame)
        for car, part in enumerate(parts):
            part["pictures"] = _maps(view, pair, loaded.detections, settings, prior, car, cars.states(car))
    return parts


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
        "pictures": {},
    }


def _maps(
    view: _View,
    pair: ViewedPair,
    detections: Detections,
    settings: DetailSettings,
    prior: ShapePrior,
    car: int,
    states: dict[str, CarState],
) -> dict[str, str]:
    """Maps by the names "photometric_before" and so on."""
    window = window_of_states(view.image, view.K, list(states.values()))
    if window is None:
        return {}
    has_mask = bool(detections.has_mask_left[car])
    foreground = detections.mask_left[car].float().numpy() if has_mask else None
    hidden = _hidden(detections, car, window, settings.occlusion_order)
    pictures = {}
    for name, state in states.items():
        maps = residual_maps(pair, prior, state.T_cam_obj, state.code, window, foreground, hidden, settings.maps)
        pictures[f"photometric_{name}"] = data_url(photometric_picture(view.image, window, maps.photometric))
        if maps.silhouette is not None:
            pictures[f"silhouette_{name}"] = data_url(silhouette_picture(view.image, window, maps.silhouette))
    return pictures


def _hidden(detections: Detections, car: int, window: Window, order: OcclusionOrder) -> npt.NDArray[np.bool_]:
    """(H, W), true where an instance in front of the car covers a pixel of the window."""
    u0, v0, u1, v1 = window
    hidden = torch.zeros(detections.mask_left.shape[1:], dtype=torch.bool)
    hidden[v0:v1, u0:u1] = occlusion_map(detections, "left", order).window(car, window)
    return np.asarray(hidden.numpy())


def _scene(view: _View | None, loaded: LoadedFrame | None, cars: DrawnCars, ground_source: str) -> dict[str, Any]:
    """Image with its camera, ground, and for each car pose, boxes and mesh, in the left camera frame."""
    ground = None if loaded is None else loaded.frame.ground
    return {
        "image": None if view is None else data_url(view.image, FRAME_QUALITY),
        "size_wh": None if view is None else [view.image.shape[1], view.image.shape[0]],
        "K": None if view is None else numbers(view.K.reshape(-1), 3),
        "ground": None if ground is None else numbers([*ground.normal[0].tolist(), float(ground.offset[0])], 6),
        "ground_source": ground_source,
        "truth": [numbers(corners.reshape(-1), 3) for corners in cars.truth],
        "cars": [_car(cars.states(car)) for car in range(len(cars.after))],
    }


def _car(states: dict[str, CarState]) -> dict[str, Any]:
    before, after = states.get("before"), states["after"]
    return {
        "T_cam_obj": numbers(after.T_cam_obj.reshape(-1), 5),
        "box_before": None if before is None else numbers(before.corners_cam.reshape(-1), 3),
        "box_after": numbers(after.corners_cam.reshape(-1), 3),
        # None for the mean shape, which the page has once.
        "mesh": None if after.mesh is None or after is before else mesh_data(after.mesh.vertices_obj, after.mesh.faces),
    }
