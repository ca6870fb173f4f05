"""This module has other tools' conventions of 3D boxes and focal lengths, and scores how they explain images."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import permutations, product
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from directshape_torch.check.car_evidence import CarBoxes, FrameEvidence
from directshape_torch.geometry.box3d import pose_from_kitti
from directshape_torch.geometry.box_formats import BoxForm
from directshape_torch.geometry.image_boxes import box_iou, project_boxes
from directshape_torch.geometry.stereo_camera import StereoCamera

Points = NDArray[np.float64]  # (N, 3)
Angles = NDArray[np.float64]  # (N,)


def _identity(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return values


def _axes(*signed: int) -> Callable[[Points], Points]:
    """A function that takes axes 1, 2, 3 of the file, with their signs, as x, y, z."""
    index, sign = [abs(axis) - 1 for axis in signed], np.sign(signed)
    return lambda points: points[:, index] * sign


AS_DOCUMENTED = "as documented"


@dataclass(frozen=True)
class Axes:
    """An `Axes` corrects boxes that were read as documented but have other axes.

    It maps locations (N, 3) and KITTI's headings (N,) in the left camera's frame to the correct ones.
    """

    points: Callable[[Points], Points] = _identity
    yaw: Callable[[Angles], Angles] = _identity


# These are for boxes in a camera's frame; their headings count as documented.
_CAMERA_AXES: dict[str, Axes] = {
    AS_DOCUMENTED: Axes(),
    "x to the left (left-handed)": Axes(_axes(-1, 2, 3)),
    "y up": Axes(_axes(1, -2, 3)),
    "OpenGL's: y up, z backward": Axes(_axes(1, -2, -3)),
    "LiDAR's: x forward, y left, z up": Axes(_axes(-2, -3, 1)),
    "z up, y forward": Axes(_axes(1, -3, 2)),
}
_A_CAMERAS = "a camera's: x right, y down, z forward"
# These are for boxes, also headings, that a motion transformed to the camera from a frame with z up.
_UPRIGHT_AXES: dict[str, Axes] = {
    AS_DOCUMENTED: Axes(),
    "left-handed, sideways the other way round": Axes(_axes(-1, 2, 3), lambda yaw: np.pi - yaw),
    "left-handed, ahead the other way round": Axes(_axes(1, 2, -3), np.negative),
    "turned by -90 degrees about z": Axes(_axes(3, 2, -1), lambda yaw: yaw + np.pi / 2),
    "turned by 90 degrees about z": Axes(_axes(-3, 2, 1), lambda yaw: yaw - np.pi / 2),
    f"{_A_CAMERAS}, not x forward, y left, z up": Axes(_axes(3, -1, -2), lambda yaw: -yaw - np.pi / 2),
    f"{_A_CAMERAS}, not x right, y forward, z up": Axes(_axes(1, 3, -2), np.negative),
}
_DOWN = np.array([0.0, 1.0, 0.0])
# This share of the height is added to y.
ORIGINS: dict[str, float] = {AS_DOCUMENTED: 0.0, "lower by a half": 0.5, "lower by a height": 1.0, "higher": -0.5}
_POINTS = {0.0: "centre of the bottom face", 0.5: "centre of the box", 1.0: "top of the box"}
YAWS: dict[str, Callable[[Angles], Angles]] = {
    AS_DOCUMENTED: _identity,
    "opposite sign": lambda yaw: -yaw,
    "offset by 90 degrees": lambda yaw: yaw + np.pi / 2,
    "opposite sign and offset by 90 degrees": lambda yaw: -yaw - np.pi / 2,
    "degrees": np.deg2rad,
    "degrees, opposite sign": lambda yaw: -np.deg2rad(yaw),
}
# These are orders in the place of h w l, with the indices of h, w and l.
ORDERS: dict[str, tuple[int, int, int]] = {
    AS_DOCUMENTED if order == "hwl" else " ".join(order): (order.index("h"), order.index("w"), order.index("l"))
    for order in map("".join, permutations("hwl"))
}
# These factors convert the given values to pixels and metres, for example from millimetres, feet or halves. Distances
# of a detector that was trained for another camera may be wrong by more than a quarter, and are checked by the images.
FOCALS = (0.4, 0.5, 0.6, 0.7, 0.8, 1.25, 1.4, 1.6, 2.0, 2.5)
DISTANCES = (0.001, 0.01, 0.1, 0.3048, 0.5, 0.65, 1.5, 2.0, 1 / 0.3048, 10.0, 100.0, 1000.0)
SIZES = (0.5, 2.0)


@dataclass(frozen=True)
class BoxConvention:
    """A `BoxConvention` is one way to write a box; each part is a key of a table above, or a factor."""

    axes: str = AS_DOCUMENTED  # keys of the tables
    origin: str = AS_DOCUMENTED
    yaw: str = AS_DOCUMENTED
    order: str = AS_DOCUMENTED
    focal: float = 1.0  # factor of the focal lengths
    distance: float = 1.0  # factor of the locations
    size: float = 1.0  # factor of height, width and length

    @property
    def deviations(self) -> dict[str, str | float]:
        """The parts that are not as documented."""
        return {part: value for part, value in vars(self).items() if value not in (AS_DOCUMENTED, 1.0)}

    def to_kitti(self, boxes: CarBoxes, form: BoxForm) -> CarBoxes:
        """The corrected boxes, if boxes of the given form were written in this convention."""
        hwl = self.size * boxes.hwl[:, list(ORDERS[self.order])]
        axes = _axes_of(form)[self.axes]
        # The bottom was computed from the height, so the location is recovered from it before the correction.
        location = boxes.location - form.raised * boxes.hwl[:, :1] * _DOWN
        location = self.distance * axes.points(location)
        location = location + (form.raised + ORIGINS[self.origin]) * hwl[:, :1] * _DOWN
        yaw = axes.yaw(YAWS[self.yaw](boxes.rotation_y))
        return CarBoxes(location, hwl, yaw, boxes.alpha, boxes.box_2d)


def _axes_of(form: BoxForm) -> dict[str, Axes]:
    return _UPRIGHT_AXES if form.upright else _CAMERA_AXES


def all_conventions(form: BoxForm) -> tuple[BoxConvention, ...]:
    """Every combination of axes, origin, heading and order, the documented one first, then single factors."""
    origins = [name for name, share in ORIGINS.items() if share + form.raised in _POINTS]
    return (
        *(BoxConvention(*parts) for parts in product(_axes_of(form), origins, YAWS, ORDERS)),
        *(BoxConvention(focal=factor) for factor in FOCALS),
        *(BoxConvention(distance=factor) for factor in DISTANCES),
        *(BoxConvention(size=factor) for factor in SIZES),
    )


def spoken(part: str, value: str | float, form: BoxForm) -> str:
    """A deviation in the terms of the form of the boxes."""
    if part == "origin":
        return _POINTS[ORIGINS[str(value)] + form.raised]
    if part == "order":
        in_place = dict(zip("hwl", str(value).split(), strict=True))
        return " ".join(in_place[size] for size in form.sizes)
    if part == "yaw" and value == "opposite sign and offset by 90 degrees":
        return f"{value} ({'a camera' if form.upright else 'LiDAR'}'s)"
    return str(value)


# The documented convention is preferred to one that explains the image only a little better.
_PENALTY_PER_DEVIATION = 0.02
# Cars are longer than they are wide or high. A turned box and a swapped pair of lengths have the same projection.
_PENALTY_SHORT_CARS = 0.2
# From this mean IoU on, 2D boxes are taken for projections of the 3D ones.
_SAME_BOX = 0.95
# This is added to the score if all observation angles agree with heading and position.
_ANGLE_WEIGHT = 0.15
_ANGLE_TOLERANCE_RAD = 0.06
# Larger angles are KITTI's number for unknown angles, or are not in radians.
_MAX_ANGLE_RAD = 2 * np.pi + 0.01


class ConventionScores(NamedTuple):
    """A `ConventionScores` says how well boxes explain the image, for C conventions."""

    conventions: tuple[BoxConvention, ...]  # the documented one first
    overlap: NDArray[np.float64]  # (C, N) IoU of N projected boxes with the image's boxes
    score: NDArray[np.float64]  # (C,) mean IoU less a penalty for deviations
    # (C,) share of the cars whose observation angle `alpha` agrees with heading and position; None if alpha is
    # unusable.
    angle_share: NDArray[np.float64] | None

    @property
    def score_with_angles(self) -> NDArray[np.float64]:  # (C,)
        """The scores with a bonus for observation angles that agree."""
        return np.asarray(self.score + _ANGLE_WEIGHT * (0.0 if self.angle_share is None else self.angle_share))


def score_conventions(frames: Sequence[FrameEvidence]) -> ConventionScores:
    """The scores over the cars of all frames, which must have at least one car.

    Projected boxes are compared with the 2D box of the detection and with the masks, and the best IoU counts. If the 2D
    boxes are projections of the 3D ones, only masks are used, and only as many cars as there are masks.
    """
    conventions = all_conventions(frames[0].words.form)
    projections = boxes_are_projections(frames)
    overlap = np.concatenate([_overlaps(frame, conventions, projections) for frame in frames], axis=1)
    median_hwl = np.median(np.concatenate([frame.boxes.hwl for frame in frames]), axis=0)
    penalty = np.array([_penalty(convention, median_hwl) for convention in conventions])
    alpha, angle_share = np.concatenate([frame.boxes.alpha for frame in frames]), None
    if (np.abs(alpha) <= _MAX_ANGLE_RAD).all() and (len(alpha) == 1 or np.ptp(alpha) > 0):  # false for NaN
        # Origin and order do not change an angle seen from above.
        share = {
            (axes, yaw): _angles_agree(BoxConvention(axes, yaw=yaw), frames)
            for axes, yaw in product({each.axes for each in conventions}, YAWS)
        }
        angle_share = np.array([share[convention.axes, convention.yaw] for convention in conventions])
    return ConventionScores(conventions, overlap, overlap.mean(axis=1) - penalty, angle_share)


def _angles_agree(convention: BoxConvention, frames: Sequence[FrameEvidence]) -> float:
    """Share of the cars with `alpha = rotation_y - atan2(x, z)` within the tolerance."""
    agree = []
    for boxes in (convention.to_kitti(frame.boxes, frame.words.form) for frame in frames):
        expected = boxes.rotation_y - np.arctan2(boxes.location[:, 0], boxes.location[:, 2])
        difference = np.angle(np.exp(1j * (boxes.alpha - expected)))
        agree.append(np.abs(difference) < _ANGLE_TOLERANCE_RAD)
    return float(np.concatenate(agree).mean())


def _penalty(convention: BoxConvention, median_hwl: NDArray[np.float64]) -> float:
    height, width, length = median_hwl[list(ORDERS[convention.order])]
    short = length < max(height, width)
    return _PENALTY_PER_DEVIATION * len(convention.deviations) + _PENALTY_SHORT_CARS * bool(short)


def _overlaps(
    frame: FrameEvidence, conventions: Sequence[BoxConvention], boxes_are_projections: bool
) -> NDArray[np.float64]:  # (C, N), or the best cars of each convention if there are fewer masks
    projected = project_conventions(frame, conventions)
    overlaps = np.zeros(projected.shape[:2])
    for car in range(len(frame.boxes)):
        own = frame.seen[car]
        own = own if boxes_are_projections else np.concatenate([own, frame.boxes.box_2d[car : car + 1]])
        if len(own):
            overlaps[:, car] = box_iou(projected[:, car], own).max(axis=1)
    if not boxes_are_projections:
        return overlaps
    return -np.sort(-overlaps, axis=1)[:, : min(len(frame.boxes), frame.num_masks["left"])]


def boxes_are_projections(frames: Sequence[FrameEvidence]) -> bool:
    """Whether the 2D boxes are projections of the 3D ones, read as documented, and so contain no evidence.

    Without masks the 2D boxes are used in any case.
    """
    if not any(frame.num_masks["left"] for frame in frames):
        return False
    overlaps = [box_iou(projected_boxes(frame), frame.boxes.box_2d).diagonal() for frame in frames]
    return bool(np.mean(np.concatenate(overlaps)) > _SAME_BOX)


def projected_boxes(frame: FrameEvidence) -> NDArray[np.float64]:  # (N, 4) pixels
    """2D boxes around the 3D boxes in the left image, read as documented."""
    return np.asarray(project_conventions(frame, [BoxConvention()])[0])


def project_conventions(
    frame: FrameEvidence, conventions: Sequence[BoxConvention]
) -> NDArray[np.float64]:  # (C, N, 4) pixels
    """2D boxes around the 3D boxes in the left image, under each convention."""
    projected = np.empty((len(conventions), len(frame.boxes), 4))
    if not len(frame.boxes):
        return projected
    for focal in {convention.focal for convention in conventions}:
        rows = [row for row, convention in enumerate(conventions) if convention.focal == focal]
        found = [conventions[row].to_kitti(frame.boxes, frame.words.form) for row in rows]
        T_cam_obj = pose_from_kitti(
            torch.from_numpy(np.concatenate([boxes.location for boxes in found])) + frame.camera.t_cam_ref[0],
            torch.from_numpy(np.concatenate([boxes.rotation_y for boxes in found])),
        )
        hwl = torch.from_numpy(np.concatenate([boxes.hwl for boxes in found]))
        boxes_2d, _ = project_boxes(T_cam_obj, hwl, _with_focal(frame.camera, focal), frame.size_hw)
        projected[rows] = boxes_2d.reshape(len(rows), len(frame.boxes), 4)
    return projected


def _with_focal(camera: StereoCamera, factor: float) -> StereoCamera:
    K_left = camera.K_left.clone()
    K_left[:, 0, 0] *= factor
    K_left[:, 1, 1] *= factor
    return replace(camera, K_left=K_left, disparity_field=None)
