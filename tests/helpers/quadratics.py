"""This module has problems with known minima for the solver: linear least squares, and problems with faults."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Annotated, NamedTuple, Self

import torch
from torch import Tensor

from directshape_torch.config import StageConfig
from directshape_torch.numerics.records import Dense
from directshape_torch.numerics.tables import Chosen
from directshape_torch.solver.problem import where_rows
from directshape_torch.solver.sharing import INDEPENDENT, Sharing


class Vector(NamedTuple):
    """A `Vector` is the state of B problems, one point for each."""

    x: Annotated[Tensor, Dense("B", "D")]


class Energy(NamedTuple):
    """An `Energy` has cost, gradient and Gauss-Newton matrix of B problems, and the evaluated points."""

    cost: Annotated[Tensor, Dense("B")]
    gradient: Annotated[Tensor, Dense("B", "D")]
    hessian: Annotated[Tensor, Dense("B", "D", "D")]
    x: Annotated[Tensor, Dense("B", "D")]


class VectorProblem:
    """A `VectorProblem` is B problems over points whose stages fix nothing, with stages and iterations in one class.

    A subclass defines the energy and the subset of problems that are left.
    """

    def __init__(self, stages: Sequence[StageConfig], num_unknowns: int, limit: float = 1e6) -> None:
        self.stage_configs, self.num_unknowns, self.limit = list(stages), num_unknowns, limit
        self.begun: list[StageConfig] = []
        self.sharing: Sharing = INDEPENDENT

    def energy(self, x: Tensor) -> Energy:
        """The energy at points (B, D)."""
        raise NotImplementedError

    def of(self, problems: Chosen) -> Self:
        """The problems that are chosen."""
        raise NotImplementedError

    def stages(self) -> list[StageConfig]:
        return self.stage_configs

    def prepare(self, state: Vector) -> Vector:
        return state

    def begin(self, stage: int, seen: Vector) -> Self:
        self.begun.append(self.stage_configs[stage])
        return self

    def figures(self, seen: Vector) -> Energy:
        return self.energy(seen.x)

    def start(self, seen: Vector) -> tuple[Self, Energy]:
        return self, self.evaluate(seen, None)

    def evaluate(self, state: Vector, near: Energy | None) -> Energy:
        return self.energy(state.x)

    def choose(self, accepted: Tensor, new: Energy, old: Energy) -> Energy:
        return where_rows(accepted, new, old)

    def retract(self, state: Vector, step: Tensor) -> Vector:
        return Vector(state.x + step)

    def step_limits(self) -> Tensor:
        return torch.full((self.num_unknowns,), self.limit, dtype=torch.float64)

    def all_at_once(self, *_: object) -> None:
        return None


class ResidualProblem(VectorProblem):
    """A `ResidualProblem` minimises `sum_i r_i(x)^2 / 2` of a residual for each problem, with autograd Jacobians.

    It records the points of evaluation and the near points that it was given.
    """

    def __init__(
        self,
        residual: Callable[[Tensor, Tensor], Tensor],
        identity: Tensor,
        num_unknowns: int,
        stages: Sequence[StageConfig],
        limit: float = 1e6,
    ) -> None:
        super().__init__(stages, num_unknowns, limit)
        self.residual, self.identity = residual, identity
        self.evaluated: list[Tensor] = []
        self.near: list[Tensor] = []

    def energy(self, x: Tensor) -> Energy:
        r = self.residual(x, self.identity)
        if len(x):
            with torch.enable_grad():
                J = torch.func.vmap(torch.func.jacrev(lambda x, i: self.residual(x[None], i[None])[0]))(
                    x, self.identity
                )
        else:
            J = r.new_zeros(0, r.shape[1], self.num_unknowns)
        return Energy(0.5 * (r * r).sum(1), (J.mT @ r[..., None])[..., 0], J.mT @ J, x)

    def evaluate(self, state: Vector, near: Energy | None) -> Energy:
        self.evaluated.append(state.x)
        if near is not None:
            self.near.append(near.x)
        return super().evaluate(state, near)

    def of(self, problems: Chosen) -> Self:
        part = type(self).__new__(type(self))
        identity, sharing = self.identity[problems.index], self.sharing.of(problems)
        part.__dict__ = {**self.__dict__, "identity": identity, "sharing": sharing}
        return part


def linear_problem(
    num_problems: int, num_unknowns: int, stages: Sequence[StageConfig]
) -> tuple[ResidualProblem, Tensor]:
    """A problem `r = A_i x - b_i` with its least-squares solution (B, D)."""
    generator = torch.Generator().manual_seed(12)
    A = torch.randn(num_problems, 2 * num_unknowns, num_unknowns, generator=generator, dtype=torch.float64)
    b = torch.randn(num_problems, 2 * num_unknowns, generator=generator, dtype=torch.float64)
    solution = torch.linalg.lstsq(A, b[..., None]).solution[..., 0]

    def residual(x: Tensor, identity: Tensor) -> Tensor:
        return (A[identity] @ x[..., None])[..., 0] - b[identity]

    return ResidualProblem(residual, torch.arange(num_problems), num_unknowns, stages), solution
