"""The unknowns of a car: the one place that knows which columns of a tangent they are, and how they move.

A state is a named tuple with one tensor for each block of unknowns. Terms name the blocks that they see and give
derivatives by those; everybody else asks `state.unknowns` for columns.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import Literal, NamedTuple, Protocol, TypeVar

import torch
from torch import Tensor

from directshape_torch.geometry import se3
from directshape_torch.numerics.tensors import constant_like
from directshape_torch.solver.problem import TensorTuple, remade

POSE, CODE, OFFSET = "pose", "code", "offset"
"""The blocks of every car: its pose, its shape, and the offset of the rig's disparity where that is a guess."""

_PoseOrShape = Literal["pose", "shape"]


class Block(NamedTuple):
    """Columns of the tangent that stand beside each other, and the tensor of a state that they move."""

    name: str
    size: int  # columns; none where a state has no such unknown
    largest_step: tuple[float, ...] = (math.inf,)  # that is trusted, of each column or of all
    # A stage that moves "pose" or "shape" alone holds the blocks of the other; nobody holds a block that is neither.
    belongs_to: _PoseOrShape | None = None
    # A pose (B, 4, 4), or several (B, M, 4, 4), is moved by `exp` from the left, everything else by addition.
    is_pose: bool = False
    is_bounded: bool = False  # by the largest magnitude of a code

    def moved(self, value: Tensor, step: Tensor, max_code: float, max_angle: float) -> Tensor:
        """The value of a state after a step (B, size)."""
        if not self.size:
            return value
        if not self.is_pose:
            moved = value + step
            return moved.clamp(-max_code, max_code) if self.is_bounded else moved
        # A bound of the angle holds for steps within the trust region, which some poses have none of.
        max_angle = max_angle if math.isfinite(self.largest_step[0]) else math.inf
        flat = value.flatten(0, -3)
        return torch.bmm(se3.exp(step.reshape(-1, 6), max_angle), flat).view_as(value)


def blocks_of_car(num_codes: int, num_offsets: int) -> tuple[Block, ...]:
    """The blocks of a car by itself.

    Trust region: a larger step is scaled as a whole. A rig that is off by a pixel more between two iterations is
    another rig.
    """
    return (
        Block(POSE, 6, (0.5, 0.5, 0.5, 0.15, 0.15, 0.15), "pose", is_pose=True),
        Block(CODE, num_codes, (1.0,), "shape", is_bounded=True),
        Block(OFFSET, num_offsets, (1.0,)),
    )


LARGEST_ROTATION_RAD = math.sqrt(3) * 0.15
"""No step within the trust region turns a car by more, for none of three components is larger than its limit."""


class State(TensorTuple, Protocol):
    """Pose and shape of B cars, and what else is unknown of them: a named tuple."""

    @property
    def T_obj_cam(self) -> Tensor:
        """Left camera to object (B, 4, 4)."""
        ...

    @property
    def code(self) -> Tensor:
        """The shape (B, K), in standard deviations."""
        ...

    @property
    def offset_px(self) -> Tensor:
        """Measured minus true disparity (B, S), full-resolution pixels; S is 1, or 0 where it is known."""
        ...

    @property
    def unknowns(self) -> Unknowns:
        """Blocks of the tangent, one for each tensor in its order."""
        ...


AnyState = TypeVar("AnyState", bound=State)


@dataclass(frozen=True)
class Unknowns:
    """The blocks of a state, which are those of its tangent.

    Examples:
        >>> unknowns = Unknowns(blocks_of_car(num_codes=3, num_offsets=1))
        >>> unknowns.size, unknowns.span("code"), unknowns.span("pose", "code")
        (10, slice(6, 9, None), slice(0, 9, None))
    """

    blocks: tuple[Block, ...]

    @property
    def size(self) -> int:
        """The number D of all columns."""
        return sum(block.size for block in self.blocks)

    def span(self, *names: str) -> slice:
        """The columns of blocks that stand beside each other."""
        first, last = (self._names().index(name) for name in (names[0], names[-1]))
        between = [block for block in self.blocks[first : last + 1] if block.size or block.name in names]
        assert tuple(block.name for block in between) == names, f"{names} do not stand beside each other"
        start = sum(block.size for block in self.blocks[:first])
        return slice(start, start + sum(block.size for block in between))

    def only(self, *names: str) -> Unknowns:
        """The unknowns of some blocks, in the order of the state."""
        return Unknowns(tuple(block for block in self.blocks if block.name in names))

    def columns(self, names: Sequence[str], device: torch.device) -> Tensor:
        """The numbers of the columns of some blocks."""
        number = torch.arange(self.size, device=device)
        return torch.cat([number[self.span(name)] for name in names])

    def placed(self, J: Tensor, sees: Sequence[str]) -> Tensor:
        """A Jacobian (..., D) by all unknowns from that by the blocks which a residual `sees`, in their order.

        A Jacobian that has all D columns stays as it is.

        Examples:
            >>> Unknowns(blocks_of_car(num_codes=2, num_offsets=1)).placed(torch.ones(1, 2), ["code"])
            tensor([[0., 0., 0., 0., 0., 0., 1., 1., 0.]])
        """
        sizes = {block.name: block.size for block in self.blocks}
        seen = [name for name in sees if sizes.get(name)]
        names = [block.name for block in self.blocks if block.size]
        if J.shape[-1] == self.size:
            return J
        if not seen:
            return J.new_zeros(*J.shape[:-1], self.size)
        first = names.index(seen[0])
        if names[first : first + len(seen)] == seen:
            span = self.span(*(block.name for block in self.blocks if block.name in seen))
            return torch.nn.functional.pad(J, (span.start, self.size - span.stop))
        parts = dict(zip(seen, J.split_with_sizes([sizes[name] for name in seen], dim=-1), strict=True))
        nothing = [J.new_zeros(*J.shape[:-1], block.size) for block in self.blocks]
        return torch.cat([parts.get(b.name, zero) for b, zero in zip(self.blocks, nothing, strict=True)], dim=-1)

    def retract(
        self, state: AnyState, delta: Tensor, max_code: float = torch.inf, max_angle: float = torch.inf
    ) -> AnyState:
        """`T_obj_cam <- exp(v, omega) T_obj_cam`, `code <- code + dcode` within its bound, the others likewise.

        Args:
            state: B cars with these unknowns.
            delta: (B, D) of the blocks in their order: of a pose `(v, omega)` in metres and radians, of the code
                standard deviations, of the offset pixels.
            max_code: largest magnitude of a code component.
            max_angle: no rotation is larger, radians (see `se3.exp`).
        """
        steps = delta.to(state.code.dtype).split_with_sizes([block.size for block in self.blocks], dim=1)
        values = zip(self.blocks, state, steps, strict=True)
        return remade(state, (block.moved(value, step, max_code, max_angle) for block, value, step in values))

    def largest_steps(self, device: torch.device) -> Tensor:
        """The largest trusted step (D,) of each unknown, float64; not to be written to."""
        limits = [
            limit
            for b in self.blocks
            for limit in (b.largest_step * b.size if len(b.largest_step) == 1 else b.largest_step)
        ]
        return constant_like(tuple(limits), torch.empty(0, dtype=torch.float64, device=device))

    def moving(self, moves: Literal["both", "pose", "shape"], device: torch.device) -> Tensor:
        """Unknowns (D,) bool that a stage moves."""
        moved = [block.belongs_to in (None, moves) or moves == "both" for block in self.blocks]
        return self._by_column(moved, device)

    def free(self, state: State, max_code: float) -> Tensor:
        """Unknowns (B, D) bool of a state that no bound holds: a code component at its bound is a constant."""
        free = torch.ones_like(state.code[:, :1], dtype=torch.bool).expand(-1, self.size).clone()
        values = zip(self.blocks, state, pairwise(self._borders()), strict=True)
        for block, value, (first, last) in values:
            if block.is_bounded:
                free[:, first:last] = value.abs() < max_code
        return free

    def _names(self) -> list[str]:
        return [block.name for block in self.blocks]

    def _borders(self) -> list[int]:
        return list(accumulate((block.size for block in self.blocks), initial=0))

    def _by_column(self, flags: Sequence[bool], device: torch.device) -> Tensor:
        by_column = [flag for block, flag in zip(self.blocks, flags, strict=True) for _ in range(block.size)]
        return torch.tensor(by_column, dtype=torch.bool, device=device)
