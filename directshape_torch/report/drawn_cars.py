"""The cars of a frame as surfaces and boxes in the left camera frame, before and after."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from directshape_torch.batch.frame_outputs import T_GLTF_CAM
from directshape_torch.files.mesh_files import read_mesh
from directshape_torch.geometry.box3d import box_corners, pose_from_kitti
from directshape_torch.io.kitti_labels import KittiObject, box_corners_cam, poses_cam
from directshape_torch.io.run_folder import FrameResult
from directshape_torch.report.car_rows import is_refined
from directshape_torch.report.residual_maps import Window
from directshape_torch.shape.sdf_to_mesh import sdf_to_mesh
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.visualize.drawing import NEAR_PLANE_M, Picture, Surface, View

Array = npt.NDArray[np.floating[Any]]


@dataclass(frozen=True)
class ObjectMesh:
    """Triangles of a shape in its object frame: vertices (V, 3), metres, and faces (F, 3)."""

    vertices_obj: Array
    faces: npt.NDArray[np.integer[Any]]

    def in_camera(self, T_cam_obj: Array) -> Surface:
        """The same surface where `T_cam_obj` (4, 4) puts it."""
        return Surface(self.vertices_obj @ T_cam_obj[:3, :3].T + T_cam_obj[:3, 3], self.faces)


@dataclass(frozen=True)
class CarState:
    """A car as it is drawn, before or after.

    Attributes:
        T_cam_obj: (4, 4) of the shape.
        corners_cam: (8, 3) of its box, in the order of `box_corners`, metres.
        code: (K,) of the shape.
        mesh: the shape, or None where no prior is at hand.
    """

    T_cam_obj: Array
    corners_cam: Array
    code: Array
    mesh: ObjectMesh | None

    @property
    def surface(self) -> Surface | None:
        return None if self.mesh is None else self.mesh.in_camera(self.T_cam_obj)


@dataclass(frozen=True)
class DrawnCars:
    """The cars of a frame, in the left camera frame.

    Attributes:
        before: as they were detected, or None where nobody knows.
        after: as they are now.
        truth: (8, 3) corners of each labelled box, metres.
    """

    before: list[CarState] | None
    after: list[CarState]
    truth: list[Array]

    def states(self, car: int) -> dict[str, CarState]:
        """A car "before", where that is known, and "after"."""
        after = {"after": self.after[car]}
        return after if self.before is None else {"before": self.before[car], **after}


def states_before(
    detections: Sequence[KittiObject],
    t_cam_ref: Tensor,  # (3,)
    num_codes: int,
    mean: ObjectMesh | None,
) -> list[CarState]:
    """The mean shape at the place of each detection, with the detection's box."""
    T_cam_obj = poses_cam(detections, t_cam_ref.double())
    corners = box_corners_cam(detections, t_cam_ref).numpy()
    code = np.zeros(num_codes)
    return [CarState(T, box, code, mean) for T, box in zip(T_cam_obj.numpy(), corners, strict=True)]


def states_after(
    result: FrameResult,
    before: Sequence[CarState] | None,
    prior: ShapePrior | None,
) -> list[CarState]:
    """The refined shapes with the boxes of the result; cars that were not refined stay as they were."""
    shapes = result.shapes
    t_cam_ref = frame_t_cam_ref(result)
    location_cam = torch.from_numpy(np.asarray(shapes.boxes_location_ref, dtype=np.float64)) + t_cam_ref
    T_cam_box = pose_from_kitti(location_cam, torch.from_numpy(np.asarray(shapes.boxes_rotation_y, dtype=np.float64)))
    corners = box_corners(T_cam_box, torch.from_numpy(np.asarray(shapes.boxes_hwl, dtype=np.float64))).numpy()
    states = []
    for car, status in enumerate(shapes.statuses):
        if not is_refined(status) and before is not None:
            states.append(before[car])
            continue
        T = np.asarray(shapes.T_cam_obj[car], dtype=np.float64)
        mesh = _refined_mesh(result, car, prior, T)
        states.append(CarState(T, corners[car], np.asarray(shapes.codes[car], dtype=np.float64), mesh))
    return states


def _refined_mesh(result: FrameResult, car: int, prior: ShapePrior | None, T_cam_obj: Array) -> ObjectMesh | None:
    """From the code, or without its prior from the file that the run saved, if it did."""
    if prior is not None:
        return decoded_mesh(prior, result.shapes.codes[car])
    file = result.mesh_files[car]
    return None if file is None else saved_mesh(file, T_cam_obj)


def true_corners(labels: Sequence[KittiObject], classes: Sequence[str], t_cam_ref: Tensor) -> list[Array]:
    """(8, 3) of each labelled box of the refined classes."""
    chosen = [label for label in labels if label.type in classes and label.has_box_3d]
    return list(box_corners_cam(chosen, t_cam_ref).numpy())


def decoded_mesh(prior: ShapePrior, code: Array) -> ObjectMesh:
    """The surface of a shape code (K,)."""
    codes = torch.from_numpy(np.asarray(code, dtype=np.float64))[None].to(prior.origin)
    mesh = sdf_to_mesh(prior.values(codes)[0], prior.origin, prior.spacing_m)
    return ObjectMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces))


def saved_mesh(path: Path, T_cam_obj: Array) -> ObjectMesh:
    """The surface of a mesh file of the run, taken back from the camera to the object frame.

    Raises:
        DataFormatError: no readable mesh.
    """
    vertices_cam, faces = read_mesh(path, cure="refine the frame again")
    if path.suffix == ".glb":
        vertices_cam = vertices_cam @ T_GLTF_CAM[:3, :3]
    return ObjectMesh((vertices_cam - T_cam_obj[:3, 3]) @ T_cam_obj[:3, :3], faces)


def frame_t_cam_ref(result: FrameResult) -> Tensor:
    """`x_cam = x_ref + t_cam_ref` (3,), float64, from the states themselves; zero for a frame without cars."""
    shapes = result.shapes
    if not len(shapes.input_lines):
        return torch.zeros(3, dtype=torch.float64)
    offset = np.asarray(shapes.T_cam_obj, np.float64)[:, :3, 3] - np.asarray(shapes.T_ref_obj, np.float64)[:, :3, 3]
    return torch.from_numpy(np.median(offset, axis=0))


def window_of_states(image: Picture, K: npt.NDArray[np.float64], states: Sequence[CarState]) -> Window | None:
    """The part of the image that shows a car in all of its states, or None where it shows none."""
    return car_window(image, K, np.concatenate([state.corners_cam for state in states]))


def car_window(
    image: Picture,
    K: Array,  # (3, 3)
    points_cam: Array,  # (N, 3) metres
    least_aspect: float = 1.2,
) -> Window | None:
    """The part (u_min, v_min, u_max, v_max), half open, of the image around some points, within the image.

    Returns:
        None where the image does not show them.

    Examples:
        >>> K = np.array([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]])
        >>> car_window(np.zeros((100, 100, 3), np.uint8), K, np.array([[-1.0, -1, 10], [1, 1, 10]]))
        (35, 38, 65, 62)
    """
    visible = points_cam[points_cam[:, 2] > NEAR_PLANE_M]
    height, width = image.shape[:2]
    if not len(visible):
        return None
    pixels = np.clip(View(image, K).project(visible), 0, [width - 1, height - 1])
    (u0, v0), (u1, v1) = pixels.min(axis=0), pixels.max(axis=0)
    if u1 - u0 < 1 or v1 - v0 < 1:
        return None
    tall = 1.2 * (v1 - v0) + 1
    wide = max(1.2 * (u1 - u0) + 4, least_aspect * tall)
    u, v = (u0 + u1) / 2, (v0 + v1) / 2
    corners = (round(u - wide / 2), round(v - tall / 2), round(u + wide / 2), round(v + tall / 2))
    return max(corners[0], 0), max(corners[1], 0), min(corners[2], width), min(corners[3], height)
