"""A frame as the page draws it: image, camera, ground, and the boxes and surfaces of its cars."""

from __future__ import annotations

from typing import Any

from directshape_torch.report.drawn_frame import CarState
from directshape_torch.report.frame_inputs import FrameInputs
from directshape_torch.report.frame_material import DrawnCars
from directshape_torch.report.json_numbers import numbers
from directshape_torch.report.mesh_data import mesh_data
from directshape_torch.report.pictures import frame_url


def frame_scene(inputs: FrameInputs, cars: DrawnCars, ground_source: str) -> dict[str, Any]:
    """Image with its camera, ground, and for each car pose, boxes and mesh, in the left camera frame."""
    image = inputs.image_left
    camera = None if image is None or inputs.camera is None else inputs.camera.K_left[0].double().numpy()
    ground = inputs.ground
    return {
        "image": None if image is None else frame_url(image),
        "size_wh": None if image is None else [image.shape[1], image.shape[0]],
        "K": None if camera is None else numbers(camera.reshape(-1), 3),
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
        "mesh": None if after.mesh is None or after is before else mesh_data(after.mesh),
    }
