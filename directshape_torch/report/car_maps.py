"""What a click on a car shows: residual maps, costs by term, and the disparity profile."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from directshape_torch.io.frame_detections import build_detections
from directshape_torch.io.result_files import ShapeArrays
from directshape_torch.observation.occlusion import OcclusionOrder, occlusion_crops
from directshape_torch.report.drawn_frame import CarState
from directshape_torch.report.frame_material import DetailSettings, DrawnCars, FrameMaterial
from directshape_torch.report.json_numbers import numbers
from directshape_torch.report.map_pictures import photometric_picture, silhouette_picture
from directshape_torch.report.pictures import Window, data_url
from directshape_torch.report.residual_maps import ViewedPair, residual_maps
from directshape_torch.report.thumbnails import window_of_states
from directshape_torch.scene import Detections
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.visualize.drawing import Picture


@dataclass(frozen=True)
class _Seen:
    """A frame with its images."""

    image: Picture
    K: npt.NDArray[np.float64]
    pair: ViewedPair
    detections: Detections | None


def car_maps(material: FrameMaterial, settings: DetailSettings, cars: DrawnCars) -> list[dict[str, Any]]:
    """For each car its costs, its profile, and where images are at hand its residual maps."""
    seen = _seen(material, settings)
    parts = []
    for car in range(len(cars.after)):
        part = _figures(material.result.shapes, car)
        if seen is not None and settings.prior is not None:
            part["pictures"] = _pictures(seen, settings, settings.prior, car, cars.states(car))
        parts.append(part)
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


def _pictures(
    seen: _Seen, settings: DetailSettings, prior: ShapePrior, car: int, states: dict[str, CarState]
) -> dict[str, str]:
    """Maps by the names "photometric_before" and so on."""
    window = window_of_states(seen.image, seen.K, list(states.values()))
    if window is None:
        return {}
    foreground, hidden = _masks(seen, settings, car, window)
    pictures = {}
    for name, state in states.items():
        maps = residual_maps(seen.pair, prior, state.T_cam_obj, state.code, window, foreground, hidden, settings.maps)
        if maps.photometric is not None:
            pictures[f"photometric_{name}"] = data_url(photometric_picture(seen.image, window, maps.photometric))
        if maps.silhouette is not None:
            pictures[f"silhouette_{name}"] = data_url(silhouette_picture(seen.image, window, maps.silhouette))
    return pictures


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


def _masks(
    seen: _Seen, settings: DetailSettings, car: int, window: Window
) -> tuple[npt.NDArray[np.floating[Any]] | None, npt.NDArray[np.bool_]]:
    """Foreground probability (H, W) of the car, or None without a mask, and the pixels (H, W) that others hide."""
    if seen.detections is None:
        return None, np.zeros(seen.image.shape[:2], dtype=np.bool_)
    has_mask = bool(seen.detections.has_mask_left[car])
    foreground = seen.detections.mask_left[car].float().numpy() if has_mask else None
    return foreground, _hidden(seen.detections, car, window, settings.occlusion_order)


def _hidden(detections: Detections, car: int, window: Window, order: OcclusionOrder) -> npt.NDArray[np.bool_]:
    """(H, W), true where an instance in front of the car covers a pixel of the window."""
    u0, v0, u1, v1 = window
    hidden = torch.zeros(detections.mask_left.shape[1:], dtype=torch.bool)
    windows = torch.tensor(window).expand(len(detections), 4)
    hidden[v0:v1, u0:u1] = occlusion_crops(detections, "left", windows, order).crop(car)
    return np.asarray(hidden.numpy())
