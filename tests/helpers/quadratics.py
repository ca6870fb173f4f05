"""Problems with known minima for the solver: linear least squares, and ones that go wrong on purpose."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.config import StageConfig
from directshape_torch.solver.problem import Linearisation


class Vector(NamedTuple):
    """State of B problems: a point each."""

    x: Tensor  # (B, D)


class ResidualProblem:
    """Minimises `sum_i r_i(x)^2 / 2` of a residual given per problem, with the Jacobian by autograd."""

    def __init__(
        self,
        residual: Callable[[Tensor, Tensor], Tensor],
        identity: Tensor,
        num_unknowns: int,
        stages: Sequence[StageConfig],
        limit: float = 1e6,
    ) -> None:
        self.residual, self.identity, self.limit = residual, identity, limit
        self.num_unknowns, self._stages = num_unknowns, list(stages)
        self.begun: list[StageConfig] = []
        self.compactions: list[int] = []
        self.evaluated: list[Tensor] = []
        self.followed: list[Tensor] = []

    def stages(self) -> list[StageConfig]:
        return self._stages

    def begin_stage(self, stage: StageConfig, state: Vector) -> ResidualProblem:
        self.begun.append(stage)
        return self

    def cost(self, state: Vector) -> Tensor:
        r = self.residual(state.x, self.identity)
        return 0.5 * (r * r).sum(1)

    def linearise(self, state: Vector) -> Linearisation:
        self.evaluated.append(state.x)
        r = self.residual(state.x, self.identity)
        if len(state.x):
            with torch.enable_grad():
                J = torch.func.vmap(torch.func.jacrev(lambda x, i: self.residual(x[None], i[None])[0]))(
                    state.x, self.identity
                )
        else:
            J = r.new_zeros(0, r.shape[1], self.num_unknowns)
        gradient = (J.mT @ r[..., None])[..., 0]
        return Linearisation(0.5 * (r * r).sum(1), gradient, J.mT @ J)

    def follow(self, accepted: Tensor) -> None:
        """Nothing is tracked; kept for tests of the loop."""
        self.followed.append(accepted)

    def retract(self, state: Vector, step: Tensor) -> Vector:
        return Vector(state.x + step)

    def step_limits(self) -> Tensor:
        return torch.full((self.num_unknowns,), self.limit, dtype=torch.float64)

    def compact(self, keep: Tensor, numbers: Sequence[int]) -> ResidualProblem:
        self.compactions.append(int(keep.sum()))
        part = ResidualProblem(self.residual, self.identity[keep], self.num_unknowns, self._stages, self.limit)
        part.compactions, part.evaluated, part.followed = self.compactions, self.evaluated, self.followed
        return part


def linear_problem(
    num_problems: int, num_unknowns: int, stages: Sequence[StageConfig]
) -> tuple[ResidualProblem, Tensor]:
    """`r = A_i x - b_i` with its least-squares solution (B, D)."""
    generator = torch.Generator().manual_seed(12)
    A = torch.randn(num_problems, 2 * num_unknowns, num_unknowns, generator=generator, dtype=torch.float64)
    b = torch.randn(num_problems, 2 * num_unknowns, generator=generator, dtype=torch.float64)
    solution = torch.linalg.lstsq(A, b[..., None]).solution[..., 0]

    def residual(x: Tensor, identity: Tensor) -> Tensor:
        return (A[identity] @ x[..., None])[..., 0] - b[identity]

    return ResidualProblem(residual, torch.arange(num_problems), num_unknowns, stages), solution
