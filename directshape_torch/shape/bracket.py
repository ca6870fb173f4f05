"""Depths between which rays enter a shape, and how they are narrowed down."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class Bracket(NamedTuple):
    """Depths of rays (...) between which each enters a shape, and the signed distances there."""

    depth: Tensor  # (...) to probe next
    before: Tensor  # (...) outside
    before_sdf: Tensor  # (...)
    behind: Tensor  # (...) inside
    behind_sdf: Tensor  # (...)
    best: Tensor  # (...) the depth of the least absolute distance so far
    best_sdf: Tensor  # (...)
    last_sdf: Tensor  # (...) of the latest probe; zero before the first

    @classmethod
    def between(cls, before: Tensor, before_sdf: Tensor, behind: Tensor, behind_sdf: Tensor) -> Bracket:
        """A new one."""
        depth = _line_zero(before, before_sdf, behind, behind_sdf)
        return cls(depth, before, before_sdf, behind, behind_sdf, behind, behind_sdf, torch.zeros_like(behind_sdf))

    def probed(self, sdf: Tensor) -> Bracket:
        """With one end moved to `depth`, of signed distance (...): false position in Illinois' form."""
        inside = sdf < 0
        nearer = sdf.abs() < self.best_sdf.abs()
        # Halving the value of an end that stays a second time makes the convergence superlinear.
        again = sdf * self.last_sdf > 0
        before = torch.where(inside, self.before, self.depth)
        behind = torch.where(inside, self.depth, self.behind)
        before_sdf = torch.where(inside, torch.where(again, 0.5 * self.before_sdf, self.before_sdf), sdf)
        behind_sdf = torch.where(inside, sdf, torch.where(again, 0.5 * self.behind_sdf, self.behind_sdf))
        best, best_sdf = torch.where(nearer, self.depth, self.best), torch.where(nearer, sdf, self.best_sdf)
        depth = _line_zero(before, before_sdf, behind, behind_sdf)
        return Bracket(depth, before, before_sdf, behind, behind_sdf, best, best_sdf, sdf)


def _line_zero(before: Tensor, before_sdf: Tensor, behind: Tensor, behind_sdf: Tensor) -> Tensor:
    # The ends differ in sign, so the share is in [0, 1].
    return torch.lerp(before, behind, before_sdf / (before_sdf - behind_sdf))
