"""This module has the conventions in which other tools write 3D boxes and focal lengths."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import permutations, product
from typing import NamedTuple

import numpy as np
import torch

from directshape_torch.check.car_evidence import CarBoxes, Floats, FrameEvidence
from directshape_torch.geometry.box3d import pose_from_kitti
from directshape_torch.geometry.box_formats import BoxForm
from directshape_torch.geometry.image_boxes import project_boxes
from directshape_torch.geometry.stereo_camera import StereoCamera

AS_DOCUMENTED = "as documented"
Change = Callable[[Floats], Floats]


class Axes(NamedTuple):
    """An `Axes` corrects boxes that were read as documented but have other axes.

    The signed axes of the file, from 1, become x, y, z, and `yaw` corrects KITTI's headings (N,).
    """

    signed: tuple[int, int, int] = (1, 2, 3)
    yaw: Change = np.positive

    def points(self, points: Floats) -> Floats:
        """Locations (N, 3) with these axes taken as x, y, z."""
        return np.asarray(points[:, [abs(axis) - 1 for axis in self.signed]] * np.sign(self.signed))


# These are for boxes in a camera's frame; their headings count as documented.
_CAMERA_AXES = {
    AS_DOCUMENTED: Axes(),
    "x to the left (left-handed)": Axes((-1, 2, 3)),
    "y up": Axes((1, -2, 3)),
    "OpenGL's: y up, z backward": Axes((1, -2, -3)),
    "LiDAR's: x forward, y left, z up": Axes((-2, -3, 1)),
    "z up, y forward": Axes((1, -3, 2)),
}
_A_CAMERAS = "a camera's: x right, y down, z forward"
# These are for boxes, also headings, that a motion transformed to the camera from a frame with z up.
_UPRIGHT_AXES = {
    AS_DOCUMENTED: Axes(),
    "left-handed, sideways the other way round": Axes((-1, 2, 3), lambda yaw: np.pi - yaw),
    "left-handed, ahead the other way round": Axes((1, 2, -3), np.negative),
    "turned by -90 degrees about z": Axes((3, 2, -1), lambda yaw: yaw + np.pi / 2),
    "turned by 90 degrees about z": Axes((-3, 2, 1), lambda yaw: yaw - np.pi / 2),
    f"{_A_CAMERAS}, not x forward, y left, z up": Axes((3, -1, -2), lambda yaw: -yaw - np.pi / 2),
    f"{_A_CAMERAS}, not x right, y forward, z up": Axes((1, 3, -2), np.negative),
}
_DOWN = np.array([0.0, 1.0, 0.0])
# This share of the height is added to y.
ORIGINS: dict[str, float] = {AS_DOCUMENTED: 0.0, "lower by a half": 0.5, "lower by a height": 1.0, "higher": -0.5}
_POINTS = {0.0: "centre of the bottom face", 0.5: "centre of the box", 1.0: "top of the box"}
YAWS: dict[str, Change] = {
    AS_DOCUMENTED: np.positive,
    "opposite sign": np.negative,
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

    axes: str = AS_DOCUMENTED
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
        location = self.distance * axes.points(boxes.location - form.raised * boxes.hwl[:, :1] * _DOWN)
        location = location + (form.raised + ORIGINS[self.origin]) * hwl[:, :1] * _DOWN
        yaw = axes.yaw(YAWS[self.yaw](boxes.rotation_y))
        return replace(boxes, location=location, hwl=hwl, rotation_y=yaw)


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


def projected_boxes(frame: FrameEvidence) -> Floats:  # (N, 4) pixels
    """2D boxes around the 3D boxes in the left image, read as documented."""
    return np.asarray(project_conventions(frame, [BoxConvention()])[0])


def project_conventions(frame: FrameEvidence, conventions: Sequence[BoxConvention]) -> Floats:  # (C, N, 4) pixels
    """2D boxes around the 3D boxes in the left image, under each convention."""
    projected = np.empty((len(conventions), len(frame.boxes), 4))
    for focal in {convention.focal for convention in conventions} if len(frame.boxes) else ():
        rows = [row for row, convention in enumerate(conventions) if convention.focal == focal]
        found = [conventions[row].to_kitti(frame.boxes, frame.words.form) for row in rows]
        location, hwl, yaw = (
            torch.from_numpy(np.concatenate([getattr(boxes, name) for boxes in found]))
            for name in ("location", "hwl", "rotation_y")
        )
        T_cam_obj = pose_from_kitti(location + frame.camera.t_cam_ref[0], yaw)
        boxes_2d, _ = project_boxes(T_cam_obj, hwl, _with_focal(frame.camera, focal), frame.size_hw)
        projected[rows] = boxes_2d.reshape(len(rows), len(frame.boxes), 4)
    return projected


def _with_focal(camera: StereoCamera, factor: float) -> StereoCamera:
    K_left = camera.K_left.clone()
    K_left[:, 0, 0] *= factor
    K_left[:, 1, 1] *= factor
    return replace(camera, K_left=K_left, disparity_field=None)
