"""Problems that share unknowns: the views of one car have poses of their own and one shape.

The solver asks a `Sharing` for steps, sums and maxima, so that problems by themselves and problems in groups go through
one loop. A group takes a step together or not at all; it does not wait for a problem that has ended, or cannot step.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol, TypeAlias

import torch
from torch import Tensor

from directshape_torch.solver.damped_solve import (
    damped_solution,
    damped_step,
    floored_diagonal,
    general_solution,
    newton_step,
)


class Sharing(Protocol):
    """What B problems have in common; `members` (B,) bool says which of them count."""

    def damped_step(self, hessian: Tensor, gradient: Tensor, damping: Tensor, members: Tensor) -> tuple[Tensor, Tensor]:
        """The step (B, D) of `(H + mu diag(H)) step = -g`, and where (B,) there is one; see `damped_step`.

        A member without a step of its own unknowns does not spoil that of the others.
        """
        ...

    def newton_step(self, J: Tensor, gradient: Tensor) -> tuple[Tensor, Tensor]:
        """The step (B, D) of `J step = -g`, differentiable by the gradient alone, and where (B,) there is one.

        J (B, D, D) is that of each problem's own gradient by its own unknowns; a group's is the sum.
        """
        ...

    def total(self, values: Tensor, members: Tensor) -> Tensor:
        """For each problem the sum of values (B,) over its group."""
        ...

    def largest(self, values: Tensor, members: Tensor) -> Tensor:
        """For each problem the largest of the values (B,), at least 0, of its group."""
        ...

    def any(self, flags: Tensor) -> Tensor:
        """For each problem whether flags (B,) bool hold anywhere in its group."""
        ...

    def with_others(self, information: Tensor, members: Tensor) -> Tensor:
        """Fisher matrices (B, D, D) of each problem, with what the others of its group say of shared unknowns.

        The inverse is each problem's block of the inverse of the group's matrix.
        """
        ...

    def of_problems(self, numbers: Sequence[int]) -> Sharing:
        """That of fewer problems."""
        ...


class Independent:
    """Problems that share nothing: each is a group of its own."""

    def damped_step(self, hessian: Tensor, gradient: Tensor, damping: Tensor, members: Tensor) -> tuple[Tensor, Tensor]:
        return damped_step(hessian, gradient, damping)

    def newton_step(self, J: Tensor, gradient: Tensor) -> tuple[Tensor, Tensor]:
        return newton_step(J, gradient)

    def total(self, values: Tensor, members: Tensor) -> Tensor:
        return values

    def largest(self, values: Tensor, members: Tensor) -> Tensor:
        return values

    def any(self, flags: Tensor) -> Tensor:
        return flags

    def with_others(self, information: Tensor, members: Tensor) -> Tensor:
        return information

    def of_problems(self, numbers: Sequence[int]) -> Independent:
        return self


INDEPENDENT = Independent()

_Solve: TypeAlias = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]


@dataclass(frozen=True)
class Groups:
    """B problems in G groups of at most F, which share some of their D unknowns.

    Their own unknowns are eliminated problem by problem (Schur's complement), so that time and memory grow with the
    problems and not with the square of a group.

    Attributes:
        group: (B,) of each problem, as the host knows it.
        own, shared: (P,) and (K,) numbers of the unknowns.
        of_problem: (B,) the group on the device.
        is_alone: (B,) bool, the only problem of its group.
        rows: (G, F) the problem in each place; an empty place repeats the first.
        filled: (G, F) bool.
    """

    group: tuple[int, ...]
    own: Tensor
    shared: Tensor
    of_problem: Tensor
    is_alone: Tensor
    rows: Tensor
    filled: Tensor

    @classmethod
    def of(cls, group: Sequence[int], own: Tensor, shared: Tensor) -> Groups:
        """Problems of the same number share.

        Examples:
            >>> groups = Groups.of([7, 3, 7], own=torch.arange(6), shared=torch.arange(6, 8))
            >>> groups.of_problem, groups.rows
            (tensor([0, 1, 0]), tensor([[0, 2],
                    [1, 1]]))
        """
        sizes = Counter(group)
        places = {name: place for place, name in enumerate(sizes)}
        rows: list[list[int]] = [[] for _ in sizes]
        for row, name in enumerate(group):
            rows[places[name]].append(row)
        longest = max(sizes.values(), default=0)
        filled = [[place < len(members) for place in range(longest)] for members in rows]
        padded = [members + members[:1] * (longest - len(members)) for members in rows]
        index = partial(torch.tensor, device=own.device, dtype=torch.long)
        return cls(
            group=tuple(group),
            own=own,
            shared=shared,
            of_problem=index([places[name] for name in group]),
            is_alone=index([sizes[name] for name in group]) == 1,
            rows=index(padded).view(len(rows), longest),
            filled=index(filled).view(len(rows), longest).bool(),
        )

    def of_problems(self, numbers: Sequence[int]) -> Groups:
        return Groups.of([self.group[number] for number in numbers], self.own, self.shared)

    def total(self, values: Tensor, members: Tensor) -> Tensor:
        return self._members(values, members).sum(dim=1)[self.of_problem]

    def largest(self, values: Tensor, members: Tensor) -> Tensor:
        return self._members(values, members).amax(dim=1)[self.of_problem]

    def any(self, flags: Tensor) -> Tensor:
        return (self.filled & flags[self.rows]).any(dim=1)[self.of_problem]

    def damped_step(self, hessian: Tensor, gradient: Tensor, damping: Tensor, members: Tensor) -> tuple[Tensor, Tensor]:
        damped = hessian + torch.diag_embed(damping[:, None] * floored_diagonal(hessian))
        together = self._step(damped, gradient, _undamped_solution, members)
        return self._unless_alone(damped_step(self._of_the_alone(hessian), gradient, damping), together)

    def newton_step(self, J: Tensor, gradient: Tensor) -> tuple[Tensor, Tensor]:
        everybody = torch.ones_like(self.is_alone)
        together = self._step(J.detach(), gradient, general_solution, everybody)
        return self._unless_alone(newton_step(self._of_the_alone(J), gradient), together)

    def with_others(self, information: Tensor, members: Tensor) -> Tensor:
        of_each, _, solvable = said_of_shared(information, torch.zeros_like(information[:, 0]), self.own, self.shared)
        members = members & solvable
        of_each = torch.where(members[:, None, None], of_each, 0.0)
        widened = information.clone()
        widened[:, self.shared[:, None], self.shared] += self.total(of_each, members) - of_each
        return widened

    def _members(self, values: Tensor, members: Tensor) -> Tensor:
        """Values (B, ...) in their places (G, F, ...), 0 in those without a member."""
        is_member = self.filled & members[self.rows]
        return torch.where(is_member.view(*is_member.shape, *(1,) * (values.ndim - 1)), values[self.rows], 0)

    def _of_the_alone(self, matrix: Tensor) -> Tensor:
        """Matrices (B, D, D) of those by themselves; another's own says nothing of some unknowns, and what cannot be
        solved has NaN as its gradient even where nobody takes the solution."""
        identity = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
        return torch.where(self.is_alone[:, None, None], matrix, identity)

    def _unless_alone(self, alone: tuple[Tensor, Tensor], together: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        """To the bit what problems that share nothing get."""
        step = torch.where(self.is_alone[:, None], alone[0], together[0])
        return step, torch.where(self.is_alone, alone[1], together[1])

    def _step(self, matrix: Tensor, gradient: Tensor, solve: _Solve, members: Tensor) -> tuple[Tensor, Tensor]:
        W, of_each, right, solvable = _reduced(matrix, gradient, self.own, self.shared, solve)
        members = members & solvable
        common, has_step = solve(self.total(of_each, members), self.total(right, members)[:, :, None])
        own = W[:, :, :1] + W[:, :, 1:] @ common
        nothing, solvable = torch.zeros_like(gradient), members & has_step
        step = nothing.index_copy(1, self.own, own[:, :, 0]).index_copy(1, self.shared, common[:, :, 0])
        return torch.where(solvable[:, None], step, 0.0), solvable


def said_of_shared(
    matrix: Tensor,  # (B, D, D)
    gradient: Tensor,  # (B, D)
    own: Tensor,
    shared: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """What quadratics say of the shared unknowns alone, the own ones following: `x^T A x / 2 - r^T x`.

    Returns:
        A (B, K, K), r (B, K), and where (B,) there is one.

    Examples:
        >>> matrix, gradient = torch.tensor([[[4.0, 2.0], [2.0, 2.0]]]), torch.tensor([[4.0, 0.0]])
        >>> said_of_shared(matrix, gradient, own=torch.tensor([0]), shared=torch.tensor([1]))
        (tensor([[[1.]]]), tensor([[2.]]), tensor([True]))
    """
    return _reduced(matrix, gradient, own, shared, _undamped_solution)[1:]


def _reduced(
    matrix: Tensor, gradient: Tensor, own: Tensor, shared: Tensor, solve: _Solve
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Each problem's own unknowns as they follow the shared ones, and what it then says of these alone.

    Returns:
        W (B, P, 1 + K) of `own = W[:, :, 0] + W[:, :, 1:] @ shared`; matrix (B, K, K) and right side (B, K) of the
        shared unknowns; where (B,) there are these.
    """
    rows = matrix[:, own]
    W, solvable = solve(rows[:, :, own], -torch.cat([gradient[:, own, None], rows[:, :, shared]], dim=2))
    rows = matrix[:, shared]
    of_each = torch.cat([gradient[:, shared, None], rows[:, :, shared]], dim=2) + rows[:, :, own] @ W
    return W, of_each[:, :, 1:], -of_each[:, :, 0], solvable & of_each.flatten(1).isfinite().all(dim=1)


def _undamped_solution(matrix: Tensor, right: Tensor) -> tuple[Tensor, Tensor]:
    return damped_solution(matrix, right, torch.zeros_like(matrix[:, 0, 0]))
