"""What the solver sees of a batch of B independent least-squares problems of D unknowns each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol, TypeVar

import torch
from torch import Tensor

from directshape_torch.config import StageConfig


class Linearisation(NamedTuple):
    """Cost, gradient and Gauss-Newton matrix of each problem at one state, in float64."""

    cost: Tensor  # (B,)
    gradient: Tensor  # (B, D)
    hessian: Tensor  # (B, D, D)


StateT = TypeVar("StateT", bound=tuple[Tensor, ...])


class StageProblem(Protocol[StateT]):
    """What the iterations of a stage see of B problems, and of fewer and fewer of them."""

    def linearise(self, state: StateT) -> Linearisation:
        """Cost, gradient and Gauss-Newton matrix in the present stage."""
        ...

    def follow(self, accepted: Tensor) -> None:
        """The states of these problems (B,) bool are now those of the latest `linearise`.

        What is tracked from iteration to iteration moves on with them, and stays where it was for the others.
        """
        ...

    def retract(self, state: StateT, step: Tensor) -> StateT:
        """The state moved by tangent vectors (B, D) within the step limits: the only place where a state changes."""
        ...

    def step_limits(self) -> Tensor:
        """Largest trusted step of each unknown, (D,)."""
        ...

    def compact(self, keep: Tensor, numbers: Sequence[int]) -> StageProblem[StateT]:
        """The same problems without those where `keep` (B,) is false; `numbers` of the others, which the host knows."""
        ...


class Problem(Protocol[StateT]):
    """B problems that share nothing but the batch."""

    def stages(self) -> Sequence[StageConfig]: ...

    def begin_stage(self, stage: StageConfig, state: StateT) -> StageProblem[StateT]:
        """Fix everything that must not change while costs are compared; what the stage's iterations work on."""
        ...

    def cost(self, state: StateT) -> Tensor:
        """Cost (B,) of a state in the present stage."""
        ...

    def retract(self, state: StateT, step: Tensor) -> StateT:
        """The state moved by tangent vectors (B, D): the only place where a state changes."""
        ...

    def step_limits(self) -> Tensor:
        """Largest trusted step of each unknown, (D,)."""
        ...


class DifferentiableProblem(Problem[StateT], Protocol):
    """A problem whose linearisation can be differentiated, by the state and by whatever the problem is made of."""

    def linearise_differentiably(self, state: StateT) -> Linearisation:
        """`linearise` with an autograd graph to the state and to the problem's own inputs."""
        ...

    def free_unknowns(self, state: StateT) -> Tensor:
        """Unknowns (B, D) that are not held by a bound, bool."""
        ...


def take_rows(state: StateT, index: Tensor) -> StateT:
    """Rows of every tensor of a state."""
    return type(state)(*(x[index] for x in state))


def put_rows(state: StateT, index: Tensor, rows: StateT) -> StateT:
    """A copy of the state with some rows replaced."""
    return type(state)(*(x.index_copy(0, index, y) for x, y in zip(state, rows, strict=True)))


def where_rows(condition: Tensor, a: StateT, b: StateT) -> StateT:
    """Rows of `a` where the condition (B,) holds, else of `b`."""
    conditions = [condition]
    for _ in range(max(x.ndim for x in a) - 1):
        conditions.append(conditions[-1].unsqueeze(-1))
    return type(a)(*(torch.where(conditions[x.ndim - 1], x, y) for x, y in zip(a, b, strict=True)))
