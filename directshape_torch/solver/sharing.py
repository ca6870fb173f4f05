"""This module lets problems share unknowns: the views of one car have poses of their own and one shape.

The solver asks a `Sharing` for steps, sums and maxima, so that problems by themselves and problems in groups go through
one loop. A group takes a step together or not at all; it does not wait for a problem that has ended, or cannot step.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from directshape_torch.numerics.tables import Chosen, Table
from directshape_torch.solver.damped_solve import damped_solution, damped_step, is_finite, newton_step


class Sharing(Table):
    """A `Sharing` groups B problems, in this class one by one. `members` (B,) bool says which problems count."""

    def damped_step(self, hessian: Tensor, gradient: Tensor, damping: Tensor, members: Tensor) -> tuple[Tensor, Tensor]:
        """The step (B, D) of `(H + mu diag(H)) step = -g`, and where (B,) there is one; see `damped_step`.

        A member whose own unknowns have no step does not spoil the step of other members.
        """
        return damped_step(hessian, gradient, damping)

    def newton_step(self, J: Tensor, gradient: Tensor) -> tuple[Tensor, Tensor]:
        """The step (B, D) of `J step = -g`, differentiable by the gradient alone, and where (B,) there is one.

        J (B, D, D) is the Jacobian of each problem's gradient by its own unknowns; the Jacobian of a group is the sum.
        """
        return newton_step(J, gradient)

    def total(self, values: Tensor, members: Tensor) -> Tensor:
        """For each problem the sum of values (B,) over its group."""
        return values

    def largest(self, values: Tensor, members: Tensor) -> Tensor:
        """For each problem the largest of the values (B,), at least 0, of its group."""
        return values

    def any(self, flags: Tensor) -> Tensor:
        """For each problem whether flags (B,) bool hold anywhere in its group."""
        return flags

    def with_others(self, information: Tensor, members: Tensor) -> Tensor:
        """Fisher matrices of the problems, from matrices (B, D, D) of each alone, with the information of its group.

        The inverse is each problem's block of the inverse of the group's matrix. Unknowns of other problems are left
        out.
        """
        return information

    def of(self, problems: Chosen) -> Sharing:
        """The sharing of some of the problems."""
        return self


INDEPENDENT = Sharing()


@dataclass(frozen=True)
class Groups(Sharing):
    """`Groups` are G groups of B problems, which share some of D unknowns and step by one dense system of N a group."""

    group: tuple[int, ...]  # (B,) group of each problem, as the host knows it
    place: tuple[int, ...]  # (B,) place of each problem in its group
    own: Tensor  # (P,) numbers of the unknowns that a problem has for itself
    shared: Tensor  # (K,) numbers of the unknowns that a group has in common
    # (Q,) numbers of the unknowns that are the first own unknowns of the problem in the next place of the group, and
    # constants where that place is empty
    of_next: Tensor
    of_problem: Tensor  # (B,) group of each problem, on the device
    rows: Tensor  # (G, F) the problem in each place; an empty place repeats the first
    filled: Tensor  # (G, F) bool, which places are filled
    column: Tensor  # (B, D) column of each unknown in the system of its group

    @classmethod
    def from_numbers(
        cls,
        group: Sequence[int],
        own: Tensor,
        shared: Tensor,
        of_next: Tensor | None = None,
        place: Sequence[int] | None = None,
    ) -> Groups:
        """The groups of problems with equal numbers in `group`; without `place`, problems keep their order.

        Examples:
            >>> groups = Groups.from_numbers([7, 3, 7], own=torch.arange(2), shared=torch.arange(2, 3))
            >>> groups.rows
            tensor([[0, 2],
                    [1, 1]])
            >>> groups.column
            tensor([[0, 1, 6],
                    [0, 1, 6],
                    [2, 3, 6]])
        """
        of_next = own[:0] if of_next is None else of_next
        numbers = {name: number for number, name in enumerate(dict.fromkeys(group))}
        so_far = Counter[int]()
        come = [so_far.update([name]) or so_far[name] - 1 for name in group]
        standing = come if place is None else list(place)
        longest = max(standing, default=-1) + 1
        rows = [[group.index(name)] * longest for name in numbers]
        filled = [[False] * longest for _ in numbers]
        for row, (name, at) in enumerate(zip(group, standing, strict=True)):
            rows[numbers[name]][at], filled[numbers[name]][at] = row, True
        index = partial(torch.tensor, device=own.device, dtype=torch.long)
        first = len(own) * index(standing)[:, None]
        column = first.new_empty(len(group), len(own) + len(shared) + len(of_next))
        column[:, own] = first + torch.arange(len(own), device=own.device)
        column[:, of_next] = first + len(own) + torch.arange(len(of_next), device=own.device)
        # The system has room for one more place, because no problem follows the last.
        column[:, shared] = len(own) * (longest + 1) + torch.arange(len(shared), device=own.device)
        return cls(
            group=tuple(group),
            place=tuple(standing),
            own=own,
            shared=shared,
            of_next=of_next,
            of_problem=index([numbers[name] for name in group]),
            rows=index(rows).view(len(rows), longest),
            filled=index(filled).view(len(rows), longest).bool(),
            column=column,
        )

    @property
    def all_members(self) -> Tensor:
        """The members (B,) where all problems count."""
        return torch.ones_like(self.of_problem, dtype=torch.bool)

    def of(self, problems: Chosen) -> Groups:
        group, place = ([of_all[number] for number in problems.numbers] for of_all in (self.group, self.place))
        return Groups.from_numbers(group, self.own, self.shared, self.of_next, place)

    def total(self, values: Tensor, members: Tensor) -> Tensor:
        return self._members(values, members).sum(dim=1)[self.of_problem]

    def largest(self, values: Tensor, members: Tensor) -> Tensor:
        return self._members(values, members).amax(dim=1)[self.of_problem]

    def any(self, flags: Tensor) -> Tensor:
        return (self.filled & flags[self.rows]).any(dim=1)[self.of_problem]

    def damped_step(self, hessian: Tensor, gradient: Tensor, damping: Tensor, members: Tensor) -> tuple[Tensor, Tensor]:
        members = members & self._steps_by_itself(hessian, gradient, damping)
        of_group = self._members(damping, members).amax(dim=1)
        step, solvable = damped_step(*self._system(hessian, gradient, members), of_group)
        return self._of_problems(step, members & solvable[self.of_problem])

    def newton_step(self, J: Tensor, gradient: Tensor) -> tuple[Tensor, Tensor]:
        step, solvable = newton_step(*self._system(J.detach(), gradient, self.all_members))
        return self._of_problems(step, solvable[self.of_problem])

    def with_others(self, information: Tensor, members: Tensor) -> Tensor:
        nothing = torch.zeros_like(information[:, 0])
        members = members & self._steps_by_itself(information, nothing, nothing[:, 0])
        system, _ = self._system(information, nothing, members)
        # The diagonal of shared unknowns is raised and later lowered again, because there would be no inverse where the
        # data do not see all of them.
        seen = system.diagonal(dim1=1, dim2=2)
        is_shared = torch.arange(seen.shape[1], device=seen.device) >= seen.shape[1] - len(self.shared)
        added = torch.where(is_shared, torch.where(seen > 0, seen, 1.0), 0.0)
        covariance, has_inverse = _inverse(system + torch.diag_embed(added))
        kept = torch.cat([self.own, self.shared]).sort().values
        at, group = self.column[:, kept], self.of_problem[:, None]
        widened, is_regular = _inverse(covariance[group[..., None], at[:, :, None], at[:, None]])
        widened = widened - torch.diag_embed(added[group, at])
        members = members & has_inverse[self.of_problem] & is_regular
        return torch.where(members[:, None, None], widened, information[:, kept[:, None], kept])

    def _members(self, values: Tensor, members: Tensor) -> Tensor:
        """Values (B, ...) in their places (G, F, ...), 0 in places without a member."""
        is_member = self.filled & members[self.rows]
        return torch.where(is_member.view(*is_member.shape, *(1,) * (values.ndim - 1)), values[self.rows], 0)

    def _steps_by_itself(self, matrix: Tensor, gradient: Tensor, damping: Tensor) -> Tensor:
        """Problems (B,) with finite numbers whose own unknowns have a step while all other unknowns stay fixed."""
        _, solvable = damped_step(matrix[:, self.own[:, None], self.own], gradient[:, self.own], damping)
        return solvable & is_finite(matrix.sum(dim=(1, 2)) + gradient.sum(dim=1))

    def _system(self, matrix: Tensor, gradient: Tensor, members: Tensor) -> tuple[Tensor, Tensor]:
        """Matrices (G, N, N) and gradients (G, N) of the members together; unknowns without a member are held."""
        num_groups, size = len(self.rows), len(self.own) * (self.filled.shape[1] + 1) + len(self.shared)
        entry = self.of_problem[:, None] * size + self.column

        def total(entries: Tensor, values: Tensor) -> Tensor:
            # In float64 a processor adds values one after the other.
            values = torch.where(members.view(-1, *(1,) * (values.ndim - 1)), values, 0)
            return values.new_zeros(num_groups * size ** (values.ndim - 1)).index_put((entries,), values, True)

        owned = torch.cat([self.own, self.shared])
        is_owned = total(entry[:, owned], torch.ones_like(gradient[:, owned])).view(num_groups, size) > 0
        together = total(entry[:, :, None] * size + self.column[:, None], matrix).view(num_groups, size, size)
        identity = torch.eye(size, dtype=matrix.dtype, device=matrix.device)
        together = torch.where(is_owned[:, :, None] & is_owned[:, None], together, identity)
        return together, torch.where(is_owned, total(entry, gradient).view(num_groups, size), 0.0)

    def _of_problems(self, step: Tensor, solvable: Tensor) -> tuple[Tensor, Tensor]:
        """The steps (B, D) of all problems, from the steps of their groups (G, N), and where (B,) they are."""
        return torch.where(solvable[:, None], step[self.of_problem[:, None], self.column], 0.0), solvable


def _inverse(matrix: Tensor) -> tuple[Tensor, Tensor]:
    identity = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device).expand_as(matrix)
    return damped_solution(matrix, identity, torch.zeros_like(matrix[:, 0, 0]))


def schur_complement(
    matrix: Tensor,  # (B, D, D)
    gradient: Tensor,  # (B, D)
    own: Tensor,
    shared: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Quadratics `x^T A x / 2 - r^T x` of the shared unknowns x alone, where the own unknowns follow x.

    Returns:
        A (B, K, K), r (B, K), and where (B,) there is a quadratic.

    Examples:
        >>> matrix, gradient = torch.tensor([[[4.0, 2.0], [2.0, 2.0]]]), torch.tensor([[4.0, 0.0]])
        >>> schur_complement(matrix, gradient, own=torch.tensor([0]), shared=torch.tensor([1]))
        (tensor([[[1.]]]), tensor([[2.]]), tensor([True]))
    """
    both = torch.cat([gradient[:, :, None], matrix[:, :, shared]], dim=2)
    following, solvable = damped_solution(
        matrix[:, own[:, None], own], -both[:, own], torch.zeros_like(matrix[:, 0, 0])
    )
    of_each = both[:, shared] + matrix[:, shared[:, None], own] @ following
    return of_each[:, :, 1:], -of_each[:, :, 0], solvable & of_each.flatten(1).isfinite().all(dim=1)
