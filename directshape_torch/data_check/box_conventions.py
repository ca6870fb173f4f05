"""The ways in which other tools write 3D boxes, as functions to KITTI's way."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np
from numpy.typing import NDArray

from directshape_torch.data_check.car_evidence import CarBoxes

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


@dataclass(frozen=True)
class BoxConvention:
    """One way to write a box; each part is a key of the table above.

    Attributes:
        axes, origin, yaw, order: how the box is written.
    """

    axes: str = AS_DOCUMENTED
    origin: str = AS_DOCUMENTED
    yaw: str = AS_DOCUMENTED
    order: str = AS_DOCUMENTED

    @property
    def deviations(self) -> dict[str, str]:
        """The parts that are not as documented."""
        return {part: value for part, value in vars(self).items() if value != AS_DOCUMENTED}

    def to_kitti(self, boxes: CarBoxes) -> CarBoxes:
        """The boxes as they should have been written, if this is how they were."""
        hwl = boxes.hwl[:, list(ORDERS[self.order])]
        location = AXES[self.axes](boxes.location).copy()
        location[:, 1] += ORIGINS[self.origin] * hwl[:, 0]
        return CarBoxes(location, hwl, YAWS[self.yaw](boxes.rotation_y), boxes.alpha, boxes.box_2d)


def all_conventions() -> Iterator[BoxConvention]:
    """Every combination, the documented one first."""
    return (BoxConvention(*parts) for parts in product(AXES, ORIGINS, YAWS, ORDERS))
