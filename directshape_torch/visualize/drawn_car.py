"""This module has the drawn form of cars before and after a refinement, for pictures, pages and animations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from directshape_torch.geometry.box3d import box_corners, pose_from_kitti
from directshape_torch.io.kitti_labels import KittiObject, box_corners_cam
from directshape_torch.refinement.quality import is_front_known
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.scene.detections import Detections
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.shape.zero_level import sdf_to_mesh
from directshape_torch.status import Status
from directshape_torch.visualize.drawing import BLUE, GREY, ORANGE, Array, Colour

if TYPE_CHECKING:
    import trimesh


# More cars make a picture unreadable. No car is farther away than this distance.
_MOST_CARS, _FARTHEST_M = 60, 1e6


@dataclass(frozen=True)
class DrawnCar:
    """A `DrawnCar` is a car in one state, in the left camera frame."""

    T_cam_obj: Array  # (4, 4) of the shape
    corners_cam: Array  # (8, 3) of the box, in the order of `box_corners`, metres
    code: Array  # (K,) of the shape
    mesh: trimesh.Trimesh | None  # the shape in its object frame, or None without a prior
    line: int  # of the detection file, or row of the call
    status: str | None = None  # status of the refinement; None before it
    is_front_known: bool = True  # False where either end may be the front

    @property
    def surface(self) -> trimesh.Trimesh | None:
        """The shape in the left camera frame."""
        return None if self.mesh is None else self.mesh.copy().apply_transform(self.T_cam_obj)

    @property
    def distance_m(self) -> float:
        """Depth of the centre of the box, metres."""
        return float(self.corners_cam[:, 2].mean())

    @property
    def colour(self) -> Colour:
        """Orange before a refinement, blue after it, grey for a car that was not refined."""
        return ORANGE if self.status is None else BLUE if self.is_refined else GREY

    @property
    def is_refined(self) -> bool:
        """Whether the car is in a refined state."""
        return self.status is not None and is_refined(self.status)


def is_refined(status: str) -> bool:
    """Whether a status is one of a refined state; unknown statuses of later versions count as not refined."""
    return status in Status.__members__ and Status[status].is_refined


def most_telling(detections: Detections, result: RefinementResult, cars: Tensor) -> Tensor:
    """At most 60 cars with finite boxes, rows (M,), in their order: the refined ones first, then the nearest."""
    boxes = detections.T_cam_obj.flatten(1), detections.dimensions_hwl
    cars = cars[torch.cat([each.detach().cpu()[cars] for each in boxes], dim=1).isfinite().all(dim=1)]
    depth, refined = (x.detach().cpu()[cars] for x in (result.T_cam_obj[:, 2, 3], result.refined))
    order = torch.argsort(depth.abs().nan_to_num(nan=_FARTHEST_M) + torch.where(refined, 0.0, _FARTHEST_M), stable=True)
    return cars[order[:_MOST_CARS].sort().values]


def drawn_cars(
    detections: Detections, result: RefinementResult, lines: Sequence[int]
) -> tuple[list[DrawnCar], list[DrawnCar]]:
    """The cars of a call before and after, with their line numbers; their detected boxes must be finite."""
    mean, code, marked = mean_car(result.prior), np.zeros(result.code.shape[1]), detections.is_from_masks
    T_cam_obj, hwl = (x.detach().double().cpu() for x in (detections.T_cam_obj, detections.dimensions_hwl))
    known = [True] * len(lines) if marked is None else (~marked).tolist()
    states = zip(T_cam_obj.numpy(), box_corners(T_cam_obj, hwl).numpy(), lines, known, strict=True)
    before = [DrawnCar(T, box, code, mean, line, None, front) for T, box, line, front in states]
    return before, cars_of_result(result, lines, before)


def cars_of_result(
    result: RefinementResult, lines: Sequence[int], before: Sequence[DrawnCar] | None = None
) -> list[DrawnCar]:
    """The cars of a result, with their line numbers; cars that were not refined stay as in `before`."""
    boxes = result.boxes()
    corners = corners_cam(boxes.location_ref, boxes.rotation_y, boxes.dimensions_hwl, result.t_cam_ref)
    T_cam_obj, codes = (x.detach().cpu().numpy() for x in (result.T_cam_obj, result.code))
    statuses = [status.name for status in result.status]
    fronts = [is_front_known(each) for each in result.quality.probability_heading.tolist()]
    return cars_after(lines, statuses, T_cam_obj, codes, corners, fronts, before, result.prior)


def corners_cam(location_ref: Tensor, rotation_y: Tensor, hwl: Tensor, t_cam_ref: Tensor) -> Array:
    """Corners (B, 8, 3) of the boxes of a result in the left camera frame, `x_cam = x_ref + t_cam_ref`."""
    location_ref, rotation_y, hwl, t_cam_ref = (
        x.detach().double().cpu() for x in (location_ref, rotation_y, hwl, t_cam_ref)
    )
    return np.asarray(box_corners(pose_from_kitti(location_ref + t_cam_ref, rotation_y), hwl))


def cars_after(
    lines: Sequence[int],
    statuses: Sequence[str],
    T_cam_obj: Array,  # (B, 4, 4)
    codes: Array,  # (B, K)
    corners: Array,  # (B, 8, 3) of the boxes, left camera frame
    fronts: Sequence[bool],  # whether the front of each car is known
    before: Sequence[DrawnCar] | None,
    prior: ShapePrior | None,
) -> list[DrawnCar]:
    """The refined shapes, if the prior is known, with the boxes of the result.

    Cars that were not refined stay as in `before`, if it is given.
    """
    cars = []
    for car, status in enumerate(statuses):
        if not is_refined(status) and before is not None:
            cars.append(replace(before[car], status=status))
            continue
        T, code = T_cam_obj[car].astype(np.float64), codes[car].astype(np.float64)
        mesh = None if prior is None else decoded_car(prior, code)
        cars.append(DrawnCar(T, corners[car], code, mesh, lines[car], status, fronts[car]))
    return cars


def mean_car(prior: ShapePrior) -> trimesh.Trimesh:
    """The mean shape in its object frame."""
    return decoded_car(prior, prior.initial_code(1)[0].cpu().numpy())


def decoded_car(prior: ShapePrior, code: Array) -> trimesh.Trimesh:
    """The shape of a code (K,) in its object frame."""
    codes = torch.from_numpy(np.asarray(code, dtype=np.float64))[None].to(prior.origin)
    return sdf_to_mesh(prior.values(codes)[0], prior.origin, prior.spacing_m)


def true_corners(labels: Sequence[KittiObject] | None, classes: Sequence[str], t_cam_ref: Tensor) -> list[Array]:
    """Corners (8, 3) of each labelled box of the refined classes."""
    chosen = [label for label in labels or () if label.type in classes and label.has_box_3d]
    return list(box_corners_cam(chosen, t_cam_ref.cpu()).numpy())
