"""What the solver sees of a batch of B least-squares problems of D unknowns each.

A problem is looked at, at a state; there a stage begins, whose iterations evaluate state after state, each near the
one before. All of these are values: whoever needs one later keeps it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Protocol, SupportsIndex, TypeVar, overload

import torch
from torch import Tensor

from directshape_torch.config import StageConfig
from directshape_torch.solver.sharing import Sharing


class TensorTuple(Protocol):
    """A named tuple of tensors (B, ...), one row for each problem."""

    def __iter__(self) -> Iterator[Tensor]: ...

    @overload
    def __getitem__(self, index: SupportsIndex, /) -> Tensor: ...
    @overload
    def __getitem__(self, index: slice[Any, Any, Any], /) -> tuple[Tensor, ...]: ...


StateT = TypeVar("StateT", bound=TensorTuple)


class EnergyAt(Protocol):
    """Cost, gradient and Gauss-Newton matrix of each problem at one state, in float64."""

    @property
    def cost(self) -> Tensor:  # (B,)
        ...

    @property
    def gradient(self) -> Tensor:  # (B, D)
        ...

    @property
    def hessian(self) -> Tensor:  # (B, D, D)
        ...


class StageProblem(Protocol[StateT]):
    """What the iterations of a stage see of B problems, and of fewer and fewer of them."""

    @property
    def sharing(self) -> Sharing:
        """What the problems have in common."""
        ...

    def evaluate(self, state: StateT, near: Any) -> Any:
        """The `EnergyAt` a state next to that of another evaluation."""
        ...

    def choose(self, accepted: Tensor, new: Any, old: Any) -> Any:
        """The new evaluation of problems whose step was accepted (B,) bool, the old one of the others."""
        ...

    def retract(self, state: StateT, step: Tensor) -> StateT:
        """The state moved by tangent vectors (B, D) within the step limits: the only place where a state changes."""
        ...

    def of_problems(self, keep: Tensor, numbers: Sequence[int], at: Any) -> tuple[StageProblem[StateT], Any]:
        """The same without the problems where `keep` (B,) is false, with their evaluation.

        `numbers` of those that stay, which the host knows.
        """
        ...


class BegunStage(Protocol[StateT]):
    """A stage of all problems, with everything fixed that must not change while costs are compared."""

    def start(self, seen: Any) -> tuple[StageProblem[StateT], Any]:
        """What the iterations work on, and the `EnergyAt` the state where they begin."""
        ...

    def figures(self, seen: Any) -> Any:
        """What is said of a state that was looked at by itself; the solver compares nothing but its `cost` (B,)."""
        ...

    def linearise_differentiably(self, state: StateT) -> Any:
        """The `EnergyAt` a state, with an autograd graph to the state and to the problem's own inputs."""
        ...

    def free_unknowns(self, state: StateT) -> Tensor:
        """Unknowns (B, D) that are not held by a bound, bool."""
        ...

    def retract(self, state: StateT, step: Tensor) -> StateT:
        """The state moved by tangent vectors (B, D)."""
        ...

    def step_limits(self) -> Tensor:
        """Largest trusted step of each unknown, (D,)."""
        ...


class Problem(Protocol[StateT]):
    """B problems, by themselves or in groups that share unknowns."""

    @property
    def sharing(self) -> Sharing:
        """What the problems have in common."""
        ...

    def stages(self) -> Sequence[StageConfig]: ...

    def look(self, state: StateT) -> Any:
        """What everything that is asked of a state begins with."""
        ...

    def begin(self, stage: int, seen: Any) -> BegunStage[StateT]:
        """The stage of that number, which begins at a state that was looked at; -1 is the last one."""
        ...

    def of_problems(self, keep: Tensor) -> Problem[StateT]:
        """The problems where `keep` (B,) holds."""
        ...


def remade(state: StateT, tensors: Iterable[Tensor]) -> StateT:
    """A state of the same kind from other tensors."""
    return type(state)(*tensors)


def take_rows(state: StateT, index: Tensor) -> StateT:
    """Rows of every tensor of a state."""
    return remade(state, (x[index] for x in state))


def put_rows(state: StateT, index: Tensor, rows: StateT) -> StateT:
    """A copy of the state with some rows replaced."""
    return remade(state, (x.index_copy(0, index, y) for x, y in zip(state, rows, strict=True)))


def where_rows(condition: Tensor, a: StateT, b: StateT) -> StateT:
    """Rows of `a` where the condition (B,) holds, else of `b`."""

    def chosen(x: Tensor, y: Tensor) -> Tensor:
        # What there is nothing of is alike.
        return torch.where(condition.view(-1, *[1] * (x.ndim - 1)), x, y) if x.shape[1:].numel() else x

    return remade(a, map(chosen, a, b))
