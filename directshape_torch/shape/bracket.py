"""Depths between which rays enter a shape, and how they are narrowed down."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class Bracket(NamedTuple):
    """Depths of rays (...) between which each enters a shape, one end outside and one inside."""

    depth: Tensor  # (...) to probe next
    latest: Tensor  # (...) the end that was probed last
    latest_sdf: Tensor  # (...) signed distance there
    latest_inside: Tensor  # (...) bool
    other: Tensor  # (...) the other end
    other_sdf: Tensor  # (...) signed distance there, less where it has stayed
    best: Tensor  # (...) the depth of the least absolute distance so far
    best_distance: Tensor  # (...)

    @classmethod
    def between(cls, before: Tensor, before_sdf: Tensor, behind: Tensor, behind_sdf: Tensor) -> Bracket:
        """A new one, of depths outside and inside."""
        inside = torch.ones_like(behind_sdf, dtype=torch.bool)
        depth = _line_zero(before, before_sdf, behind, behind_sdf)
        return cls(depth, behind, behind_sdf, inside, before, before_sdf, behind, behind_sdf.abs())

    def probed(self, sdf: Tensor) -> Bracket:
        """With one end moved to `depth`, of signed distance (...): false position by nearly Illinois' rule."""
        inside = sdf < 0
        crossed = inside ^ self.latest_inside
        other = torch.where(crossed, self.latest, self.other)
        # Halving the value of an end that stays makes the convergence superlinear. Illinois' rule begins with the
        # second probe; from the first one on it takes fewer operations, and eight probes come as near.
        other_sdf = torch.where(crossed, self.latest_sdf, 0.5 * self.other_sdf)
        distance = sdf.abs()
        best = torch.where(distance < self.best_distance, self.depth, self.best)
        best_distance = torch.fmin(distance, self.best_distance)
        depth = _line_zero(other, other_sdf, self.depth, sdf)
        return Bracket(depth, self.depth, sdf, inside, other, other_sdf, best, best_distance)


def _line_zero(depth: Tensor, sdf: Tensor, other: Tensor, other_sdf: Tensor) -> Tensor:
    # One of them is not negative and the other is, so the share is in [0, 1].
    return torch.lerp(depth, other, sdf / (sdf - other_sdf))
