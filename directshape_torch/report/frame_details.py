"""Everything of one frame that the page shows on demand: thumbnails, residual maps, picture and 3D scene."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from directshape_torch.report.car_maps import car_maps
from directshape_torch.report.drawn_frame import frame_t_cam_ref, states_after, states_before, true_corners
from directshape_torch.report.frame_material import DetailSettings, DrawnCars, FrameMaterial
from directshape_torch.report.frame_scene import frame_scene
from directshape_torch.report.thumbnails import thumbnails


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
    cars = _drawn_cars(material, settings)
    return FrameDetails(
        thumbnails=thumbnails(material.inputs, cars, material.result),
        maps=car_maps(material, settings, cars),
        scene=frame_scene(material.inputs, cars, material.result.shapes.ground_source),
    )


def _drawn_cars(material: FrameMaterial, settings: DetailSettings) -> DrawnCars:
    result = material.result
    t_cam_ref = frame_t_cam_ref(result)
    before = None
    if material.detections is not None:
        before = states_before(material.detections, t_cam_ref, result.shapes.codes.shape[1], settings.mean)
    truth = [] if material.labels is None else true_corners(material.labels, settings.classes, t_cam_ref)
    return DrawnCars(before, states_after(result, before, settings.prior), truth)
