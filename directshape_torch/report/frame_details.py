"""Everything of one frame that the page shows on demand: thumbnails, residual maps, picture and 3D scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from directshape_torch.io.frame_detections import build_detections
from directshape_torch.io.kitti_labels import KittiObject
from directshape_torch.observation.occlusion import OcclusionOrder, hidden_pixels
from directshape_torch.report.drawn_frame import (
    CarState,
    ObjectMesh,
    frame_t_cam_ref,
    states_after,
    states_before,
    true_corners,
)
from directshape_torch.report.frame_inputs import FrameInputs
from directshape_torch.report.map_pictures import photometric_picture, silhouette_picture
from directshape_torch.report.mesh_data import mesh_data
from directshape_torch.report.pictures import Window, car_window, data_url, frame_url
from directshape_torch.report.residual_maps import MapSettings, ViewedPair, residual_maps
from directshape_torch.report.run_folder import FrameResult
from directshape_torch.scene import Detections
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.status import Status
from directshape_torch.visualize.drawing import (
    BLUE,
    GREY,
    ORANGE,
    Picture,
    View,
    draw_box,
    draw_contour,
)

_THUMBNAIL_WIDTH_PX = 260
_LARGEST_SCALE = 4.0


@dataclass(frozen=True)
class FrameMaterial:
    """One frame as far as it is known.

    Attributes:
        result: what the run left.
        inputs: what went in.
        lines: all lines of the detection file, or None.
        detections: those of the cars of `result`, or None.
        labels: the truth, or None.
    """

    result: FrameResult
    inputs: FrameInputs
    lines: list[KittiObject] | None
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
        occlusion_order: see `hidden_pixels`.
    """

    classes: Sequence[str]
    prior: ShapePrior | None
    mean: ObjectMesh | None
    maps: MapSettings
    occlusion_order: OcclusionOrder


@dataclass(frozen=True)
class FrameDetails:
    """Three parts, each parsed by the page when it is first needed.

    Attributes:
        thumbnails: for each car its pictures before and after.
        maps: for each car its residual maps, costs by term and disparity profile.
        scene: image, camera, ground, boxes and meshes.
    """

    thumbnails: list[dict[str, str]]
    maps: list[dict[str, Any]]
    scene: dict[str, Any]


def frame_details(material: FrameMaterial, settings: DetailSettings) -> FrameDetails:
    """The details of a frame."""
    result = material.result
    t_cam_ref = frame_t_cam_ref(result)
    num_codes = result.shapes.codes.shape[1]
    before = None
    if material.detections is not None:
        before = states_before(material.detections, t_cam_ref, num_codes, settings.mean)
    after = states_after(result, before, settings.prior)
    truth = [] if material.labels is None else true_corners(material.labels, settings.classes, t_cam_ref)
    return FrameDetails(
        thumbnails=_thumbnails(material.inputs, before, after, result),
        maps=_map_parts(material, settings, before, after),
        scene=_scene(material.inputs, result, before, after, truth),
    )


def _thumbnails(
    inputs: FrameInputs, before: Sequence[CarState] | None, after: Sequence[CarState], result: FrameResult
) -> list[dict[str, str]]:
    if inputs.image_left is None or inputs.camera is None:
        return [{} for _ in after]
    K = inputs.camera.K_left[0].double().numpy()
    pictures = []
    for car, state in enumerate(after):
        window = _window(inputs.image_left, K, [state] if before is None else [before[car], state])
        colour = BLUE if Status[result.shapes.statuses[car]].is_refined else GREY
        drawn = (
            {"after": (state, colour)}
            if before is None
            else {"before": (before[car], ORANGE), "after": (state, colour)}
        )
        pictures.append(
            {}
            if window is None
            else {name: data_url(_thumbnail(inputs.image_left, K, window, *pair)) for name, pair in drawn.items()}
        )
    return pictures


def _thumbnail(
    image: Picture, K: npt.NDArray[np.float64], window: Window, state: CarState, colour: tuple[int, int, int]
) -> Picture:
    scale = min(_THUMBNAIL_WIDTH_PX / (window[2] - window[0]), _LARGEST_SCALE)
    view = View.of_window(image, K, window, scale)
    surface = state.surface
    if surface is None:
        draw_box(view, state.corners_cam, colour)
    else:
        draw_contour(view, surface, colour, 2)
    return view.picture


def _window(image: Picture, K: npt.NDArray[np.float64], states: Sequence[CarState]) -> Window | None:
    return car_window(image, K, np.concatenate([state.corners_cam for state in states]))


def _map_parts(
    material: FrameMaterial, settings: DetailSettings, before: Sequence[CarState] | None, after: Sequence[CarState]
) -> list[dict[str, Any]]:
    """For each car its costs, its profile, and where images are at hand its residual maps."""
    shapes = material.result.shapes
    seen = _seen(material, settings)
    parts = []
    for car, state in enumerate(after):
        part: dict[str, Any] = {
            "message": shapes.messages[car],
            "terms": list(shapes.term_names),
            "costs_before": _numbers(shapes.costs_before[car]),
            "costs_after": _numbers(shapes.costs_after[car]),
            "profile_offsets_px": _numbers(shapes.profile_offsets_px),
            "profile_before": _numbers(shapes.profile_costs_before[car]),
            "profile_after": _numbers(shapes.profile_costs_after[car]),
            "sigmas_ref": _numbers(shapes.sigmas_ref[car]),
            "pictures": {},
        }
        if seen is not None and settings.prior is not None:
            drawn = [state] if before is None else [before[car], state]
            names = ["after"] if before is None else ["before", "after"]
            window = _window(seen.image, seen.K, drawn)
            if window is not None:
                for name, one in zip(names, drawn, strict=True):
                    part["pictures"] |= _maps_of_car(seen, settings, settings.prior, car, one, window, name)
        parts.append(part)
    return parts


@dataclass(frozen=True)
class _Seen:
    """A frame with its images."""

    image: Picture
    K: npt.NDArray[np.float64]
    pair: ViewedPair
    detections: Detections | None


def _seen(material: FrameMaterial, settings: DetailSettings) -> _Seen | None:
    inputs = material.inputs
    if inputs.image_left is None or inputs.camera is None:
        return None
    detections = None
    if inputs.masks and material.lines is not None:
        height, width = inputs.image_left.shape[:2]
        detections, _, _ = build_detections(
            material.lines, inputs.masks, inputs.camera, (height, width), settings.classes, inputs.given_masks
        )
    pair = ViewedPair.of_images(inputs.image_left, inputs.image_right, inputs.camera)
    return _Seen(inputs.image_left, inputs.camera.K_left[0].double().numpy(), pair, detections)


def _maps_of_car(
    seen: _Seen,
    settings: DetailSettings,
    prior: ShapePrior,
    car: int,
    state: CarState,
    window: Window,
    name: str,
) -> dict[str, str]:
    foreground, hidden = None, np.zeros(seen.image.shape[:2], dtype=np.bool_)
    if seen.detections is not None:
        if bool(seen.detections.has_mask_left[car]):
            foreground = seen.detections.mask_left[car].float().numpy()
        hidden = _hidden(seen.detections, car, window, settings.occlusion_order)
    maps = residual_maps(seen.pair, prior, state.T_cam_obj, state.code, window, foreground, hidden, settings.maps)
    pictures = {}
    if maps.photometric is not None:
        pictures[f"photometric_{name}"] = data_url(photometric_picture(seen.image, window, maps.photometric))
    if maps.silhouette is not None:
        pictures[f"silhouette_{name}"] = data_url(silhouette_picture(seen.image, window, maps.silhouette))
    return pictures


def _hidden(detections: Detections, car: int, window: Window, order: OcclusionOrder) -> npt.NDArray[np.bool_]:
    """(H, W), true where an instance in front of the car covers a pixel of the window."""
    u0, v0, u1, v1 = window
    rows, columns = torch.meshgrid(torch.arange(v0, v1), torch.arange(u0, u1), indexing="ij")
    uv = torch.stack([columns, rows], dim=-1).reshape(-1, 2)
    inside = hidden_pixels(detections, "left", torch.full((len(uv),), car), uv, order)
    hidden = torch.zeros(detections.mask_left.shape[1:], dtype=torch.bool)
    hidden[v0:v1, u0:u1] = inside.reshape(rows.shape)
    return np.asarray(hidden.numpy())


def _scene(
    inputs: FrameInputs,
    result: FrameResult,
    before: Sequence[CarState] | None,
    after: Sequence[CarState],
    truth: Sequence[npt.NDArray[np.floating[Any]]],
) -> dict[str, Any]:
    """Image with its camera, ground, and for each car pose, boxes and mesh, in the left camera frame."""
    image = inputs.image_left
    camera = None if image is None or inputs.camera is None else inputs.camera.K_left[0].double().numpy()
    ground = inputs.ground
    return {
        "image": None if image is None else frame_url(image),
        "size_wh": None if image is None else [image.shape[1], image.shape[0]],
        "K": None if camera is None else _numbers(camera.reshape(-1), 3),
        "ground": None if ground is None else _numbers([*ground.normal[0].tolist(), float(ground.offset[0])], 6),
        "ground_source": result.shapes.ground_source,
        "truth": [_numbers(corners.reshape(-1), 3) for corners in truth],
        "cars": [
            {
                "T_cam_obj": _numbers(state.T_cam_obj.reshape(-1), 5),
                "T_cam_obj_before": None if before is None else _numbers(before[car].T_cam_obj.reshape(-1), 5),
                "box_before": None if before is None else _numbers(before[car].corners_cam.reshape(-1), 3),
                "box_after": _numbers(state.corners_cam.reshape(-1), 3),
                "mesh": _mesh(state, before, car),
            }
            for car, state in enumerate(after)
        ],
    }


def _mesh(state: CarState, before: Sequence[CarState] | None, car: int) -> dict[str, str] | None:
    """None for the mean shape, which the page has once."""
    if state.mesh is None or (before is not None and state is before[car]):
        return None
    return mesh_data(state.mesh)


def _numbers(values: Sequence[float] | npt.NDArray[np.floating[Any]], decimals: int = 5) -> list[float | None]:
    return [round(float(value), decimals) if np.isfinite(value) else None for value in values]
