"""The ways in which other tools write 3D boxes and focal lengths, as functions to KITTI's way."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np
from numpy.typing import NDArray

from directshape_torch.scene_check.car_evidence import CarBoxes

Points = NDArray[np.float64]  # (N, 3)
Angles = NDArray[np.float64]  # (N,)


def _identity(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return values


def _axes(*signed: int) -> Callable[[Points], Points]:
    """Axes 1, 2, 3 of the file, with their signs, that become x, y, z."""
    index, sign = [abs(axis) - 1 for axis in signed], np.sign(signed)
    return lambda points: points[:, index] * sign


AS_DOCUMENTED = "as documented"
AXES: dict[str, Callable[[Points], Points]] = {
    AS_DOCUMENTED: _identity,
    "x to the left (left-handed)": _axes(-1, 2, 3),
    "y up": _axes(1, -2, 3),
    "OpenGL's: y up, z backward": _axes(1, -2, -3),
    "LiDAR's: x forward, y left, z up": _axes(-2, -3, 1),
    "z up, y forward": _axes(1, -3, 2),
}
# Share of the height that is to be added to y.
ORIGINS: dict[str, float] = {AS_DOCUMENTED: 0.0, "centre of the box": 0.5, "top of the box": 1.0}
YAWS: dict[str, Callable[[Angles], Angles]] = {
    AS_DOCUMENTED: _identity,
    "opposite sign": lambda yaw: -yaw,
    "offset by 90 degrees": lambda yaw: yaw + np.pi / 2,
    "opposite sign and offset by 90 degrees (LiDAR's)": lambda yaw: -yaw - np.pi / 2,
    "degrees": np.deg2rad,
    "degrees, opposite sign": lambda yaw: -np.deg2rad(yaw),
}
# The order of the file; which of its columns are h, w, l.
ORDERS: dict[str, tuple[int, int, int]] = {
    AS_DOCUMENTED if order == "hwl" else " ".join(order): (order.index("h"), order.index("w"), order.index("l"))
    for order in map("".join, permutations("hwl"))
}
# Factors that bring what is given to pixels and metres. Millimetres, feet, halves; distances of a detector that is
# trained for another camera may be off by more than a quarter, and are judged by the images.
FOCALS = (0.4, 0.5, 0.6, 0.7, 0.8, 1.25, 1.4, 1.6, 2.0, 2.5)
DISTANCES = (0.001, 0.01, 0.1, 0.3048, 0.5, 0.65, 1.5, 2.0, 1 / 0.3048, 10.0, 100.0, 1000.0)
SIZES = (0.5, 2.0)


@dataclass(frozen=True)
class BoxConvention:
    """One way to write a box; each part is a key of a table above, or a factor.

    Attributes:
        axes, origin, yaw, order: how the box is written.
        focal: factor of the focal lengths.
        distance: factor of the locations.
        size: factor of height, width and length.
    """

    axes: str = AS_DOCUMENTED
    origin: str = AS_DOCUMENTED
    yaw: str = AS_DOCUMENTED
    order: str = AS_DOCUMENTED
    focal: float = 1.0
    distance: float = 1.0
    size: float = 1.0

    @property
    def deviations(self) -> dict[str, str | float]:
        """The parts that are not as documented."""
        return {part: value for part, value in vars(self).items() if value not in (AS_DOCUMENTED, 1.0)}

    def to_kitti(self, boxes: CarBoxes) -> CarBoxes:
        """The boxes as they should have been written, if this is how they were."""
        hwl = self.size * boxes.hwl[:, list(ORDERS[self.order])]
        location = self.distance * AXES[self.axes](boxes.location)
        location[:, 1] += ORIGINS[self.origin] * hwl[:, 0]
        return CarBoxes(location, hwl, YAWS[self.yaw](boxes.rotation_y), boxes.alpha, boxes.box_2d)


def all_conventions() -> tuple[BoxConvention, ...]:
    """Every combination of axes, origin, heading and order, the documented one first; then single factors."""
    return (
        *(BoxConvention(*parts) for parts in product(AXES, ORIGINS, YAWS, ORDERS)),
        *(BoxConvention(focal=factor) for factor in FOCALS),
        *(BoxConvention(distance=factor) for factor in DISTANCES),
        *(BoxConvention(size=factor) for factor in SIZES),
    )
