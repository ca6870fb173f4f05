"""This module says what the solver needs of a batch of B least-squares problems of D unknowns each.

`prepare` fixes what depends on one state. A stage begins at that state, and its iterations evaluate state after state,
each near the state before. All results are values, which a caller may keep for later.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, Generic, NamedTuple, Protocol, Self, SupportsIndex, TypeVar, overload

import torch
from torch import Tensor

from directshape_torch.config import SolverConfig, StageConfig
from directshape_torch.numerics.records import Dense
from directshape_torch.numerics.tables import Chosen, Table
from directshape_torch.solver.sharing import Sharing


class TensorTuple(Protocol):
    """A `TensorTuple` is a named tuple of tensors (B, ...), with one row for each problem."""

    def __iter__(self) -> Iterator[Tensor]: ...

    @overload
    def __getitem__(self, index: SupportsIndex, /) -> Tensor: ...
    @overload
    def __getitem__(self, index: slice, /) -> tuple[Tensor, ...]: ...


StateT = TypeVar("StateT", bound=TensorTuple)


class EnergyAt(Protocol):
    """`EnergyAt` is the cost, gradient and Gauss-Newton matrix of each problem at one state, in float64."""

    @property
    def cost(self) -> Tensor:  # (B,)
        ...

    @property
    def gradient(self) -> Tensor:  # (B, D)
        ...

    @property
    def hessian(self) -> Tensor:  # (B, D, D)
        ...


PreparedT = TypeVar("PreparedT")
PreparedT_contra = TypeVar("PreparedT_contra", contravariant=True)
EvaluationT = TypeVar("EvaluationT", bound=EnergyAt)


class HasCost(Protocol):
    """`HasCost` are the figures of a state, of which the solver only compares the cost of each problem."""

    @property
    def cost(self) -> Tensor:  # (B,)
        ...


FiguresT = TypeVar("FiguresT", bound=HasCost)
FiguresT_co = TypeVar("FiguresT_co", bound=HasCost, covariant=True)


# A problem that goes on has this code; a problem that has ended has the code of its status.
RUNNING = -1


@dataclass
class Progress(Table, Generic[StateT, EvaluationT]):
    """`Progress` is what changes from iteration to iteration, for B problems."""

    state: StateT
    best_state: StateT
    best_cost: Annotated[Tensor, Dense("B")]
    at_state: EvaluationT
    damping: Annotated[Tensor, Dense("B")]
    # whether the next step is over-relaxed, in stages that over-relax
    stretched: Annotated[Tensor, Dense("B", kind="flags")]
    ended: Annotated[Tensor, Dense("B", kind="index")]  # status code or RUNNING
    iterations: Annotated[Tensor, Dense("B", kind="index")]


class Done(NamedTuple, Generic[StateT]):
    """What an iteration has `Done`; without a record `before`, `damping` and `stretched` are those of the end."""

    running: Tensor  # (B,) which problems took part
    cost: Tensor  # (B,) after it
    accepted: Tensor  # (B,) whose steps were taken
    before: StateT
    damping: Tensor  # (B,) before it
    stretched: Tensor  # (B,) before it


class Iterations(Protocol[StateT, EvaluationT]):
    """The `Iterations` of a stage evaluate B problems."""

    @property
    def sharing(self) -> Sharing:
        """The unknowns that problems share."""
        ...

    def evaluate(self, state: StateT, near: EvaluationT) -> EvaluationT:
        """The evaluation of a state that is near the state of another evaluation."""
        ...

    def choose(self, accepted: Tensor, new: EvaluationT, old: EvaluationT) -> EvaluationT:
        """The new evaluation of problems whose step was accepted (B,) bool, the old evaluation of other problems."""
        ...

    def retract(self, state: StateT, step: Tensor) -> StateT:
        """The state moved by tangent vectors (B, D) within the step limits: the only place where a state changes."""
        ...

    def all_at_once(
        self,
        progress: Progress[StateT, EvaluationT],
        stage: StageConfig,
        config: SolverConfig,
        limits: Tensor,
        record: bool,
    ) -> list[Done[StateT]] | None:
        """Do all iterations of a stage by native loops, and write where they end into the progress.

        Args:
            progress: of these problems where the stage begins; its evaluation is then no longer up to date.
            stage: numbers of iterations, over-relaxation.
            config: damping, acceptance, convergence.
            limits: (D,) largest trusted step of each unknown.
            record: whether to keep where each iteration began.

        Returns:
            What each iteration did; None without such loops.
        """
        ...


class Stage(Protocol[StateT, PreparedT_contra, EvaluationT, FiguresT_co]):
    """A `Stage` of all problems has begun: everything is fixed that must not change while costs compare."""

    def start(self, prepared: PreparedT_contra) -> tuple[Iterations[StateT, EvaluationT], EvaluationT]:
        """The iterations, and the evaluation of the state where they begin."""
        ...

    def figures(self, prepared: PreparedT_contra) -> FiguresT_co:
        """The figures of a state from `prepare`."""
        ...

    def linearise_differentiably(self, state: StateT) -> EvaluationT:
        """The evaluation of a state, with an autograd graph to the state and to the problem's own inputs."""
        ...

    def free_unknowns(self, state: StateT) -> Tensor:
        """Unknowns (B, D) that are not held by a bound, bool."""
        ...

    def retract(self, state: StateT, step: Tensor) -> StateT:
        """The state moved by tangent vectors (B, D)."""
        ...

    def step_limits(self) -> Tensor:
        """Largest trusted step of each unknown, (D,); not to be written to."""
        ...


class Problem(Protocol[StateT, PreparedT, EvaluationT, FiguresT_co]):
    """A `Problem` is a batch of B problems, by themselves or in groups that share unknowns."""

    @property
    def sharing(self) -> Sharing:
        """The unknowns that problems share."""
        ...

    def stages(self) -> Sequence[StageConfig]: ...

    def prepare(self, state: StateT) -> PreparedT:
        """The preparation of a state, with which stages and figures begin."""
        ...

    def begin(self, stage: int, prepared: PreparedT) -> Stage[StateT, PreparedT, EvaluationT, FiguresT_co]:
        """The stage of that number, which begins at a state from `prepare`; -1 is the last stage."""
        ...

    def of(self, problems: Chosen) -> Self:
        """Some of the problems."""
        ...


def remade(state: StateT, tensors: Iterable[Tensor]) -> StateT:
    """A state of the same kind from other tensors."""
    return type(state)(*tensors)


def put_rows(state: StateT, index: Tensor, rows: StateT) -> StateT:
    """A copy of the state with some rows replaced."""
    return remade(state, (x.index_copy(0, index, y) for x, y in zip(state, rows, strict=True)))


def where_rows(condition: Tensor, a: StateT, b: StateT) -> StateT:
    """Rows of `a` where the condition (B,) holds, else of `b`."""

    def chosen(x: Tensor, y: Tensor) -> Tensor:
        # Tensors with empty rows need no choice.
        return torch.where(condition.view(-1, *[1] * (x.ndim - 1)), x, y) if x.shape[1:].numel() else x

    return remade(a, map(chosen, a, b))
