"""Which directions a view does not show, in numbers and in words."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import torch
from torch import Tensor

from directshape_torch.numerics.records import CarRecord, Dense

CAR_QUANTITIES = ("depth", "sideways position", "height above ground", "heading", "length", "width", "height")
"""The quantities (7) that a direction is made of; all in metres.

Depth is the distance from the camera along the ground and grows away from it, the sideways position grows to the
camera's right, and the heading counts as the way of the car's end as it turns: radians times `HEADING_LEVER_M`.
"""

HEADING_LEVER_M = 2.0
"""Half the length of a typical car."""

# Partners below this share of the largest one are not worth a word.
_NAMED_SHARE = 0.2


@dataclass(frozen=True)
class Observability(CarRecord):
    """What the images say of B cars without any prior, NaN where they were not refined.

    Attributes:
        sigmas_m: (B, 7) standard deviations along the principal directions, the weakest direction first; in a result
            scaled by the calibrated factor of the depth.
        directions: (B, 7, 7) unit vectors, row i that of sigma i, columns `CAR_QUANTITIES`.
        viewing_angle_rad: (B,) KITTI's alpha of the car, which says from where it is seen.
    """

    sigmas_m: Annotated[Tensor, Dense("B", 7)]
    directions: Annotated[Tensor, Dense("B", 7, 7)]
    viewing_angle_rad: Annotated[Tensor, Dense("B")]

    @classmethod
    def nothing(cls, like: Tensor, count: int) -> Observability:
        """Directions of `count` cars of which nothing is known: NaN."""
        nan = torch.full((count,), torch.nan, dtype=torch.float64, device=like.device)
        return cls(nan[:, None].expand(-1, 7), nan[:, None, None].expand(-1, 7, 7), nan)

    def scaled(self, factor: float) -> Observability:
        """The same directions with all standard deviations multiplied by a factor."""
        return Observability(factor * self.sigmas_m, self.directions, self.viewing_angle_rad)

    def words(self) -> list[str]:
        """The weakest direction of each car, largest part first; empty for cars that were not refined.

        Examples:
            >>> direction = torch.tensor([0.45, 0.0, 0.0, 0.0, 0.89, 0.0, 0.0]).expand(1, 7, 7)
            >>> Observability(torch.full((1, 7), 0.6), direction, torch.tensor([-math.pi / 2])).words()
            ['rear view: length and depth trade 1 to 0.5 (sigma 0.60 m)']
        """
        rows = zip(self.viewing_angle_rad.tolist(), self.directions[:, 0].tolist(), self.sigmas_m[:, 0], strict=True)
        return [
            f"{view_in_words(angle)}: {direction_in_words(direction)} (sigma {sigma:.2f} m)" if sigma == sigma else ""
            for angle, direction, sigma in rows
        ]


def view_in_words(alpha_rad: float) -> str:
    """From where a car is seen at KITTI's observation angle, in steps of 45 degrees.

    Examples:
        >>> [view_in_words(math.radians(a)) for a in (-90, -50, 0, 90)]
        ['rear view', 'rear quarter view', 'side view', 'front view']
    """
    # The camera looks at the back of a car that heads away from it, where alpha is -90 degrees.
    facing = math.degrees(math.asin(max(-1.0, min(1.0, math.sin(alpha_rad)))))
    side = "front" if facing > 0 else "rear"
    if abs(facing) > 67.5:
        return f"{side} view"
    return f"{side} quarter view" if abs(facing) > 22.5 else "side view"


def direction_in_words(direction: Sequence[float]) -> str:
    """The largest parts of a direction (7,); a minus says that the one falls as the other grows.

    Examples:
        >>> direction_in_words([0.0, 0.02, 0.0, 0.0, 0.1, 0.99, 0.0])
        'width alone'
    """
    order = sorted(range(len(direction)), key=lambda i: -abs(direction[i]))
    first = direction[order[0]]
    named = [i for i in order if abs(direction[i] / first) >= _NAMED_SHARE][:3]
    names = [CAR_QUANTITIES[i] for i in named]
    if len(named) == 1:
        return f"{names[0]} alone"
    ratios = " to ".join(f"{direction[i] / first + 0.0:.1f}".removesuffix(".0") for i in named)
    return f"{', '.join(names[:-1])} and {names[-1]} trade {ratios}"
