"""This module defines the unknowns of a car: which columns of a tangent they are, and how a step moves them.

A state is a named tuple with one tensor for each block of unknowns. Terms name the blocks that they see and give
derivatives by these blocks; all other code asks `state.unknowns` for columns.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol, TypeVar

import torch
from torch import Tensor

from directshape_torch.geometry import se3
from directshape_torch.numerics.tensors import constant_like
from directshape_torch.solver.problem import TensorTuple, remade

POSE, CODE, OFFSET = "pose", "code", "offset"
"""Every car has these blocks: its pose, its shape, and the offset of the rig's disparity where it is unknown."""

_PoseOrShape = Literal["pose", "shape"]


class Block(NamedTuple):
    """A block is a group of adjacent columns of the tangent, which move one tensor of a state."""

    name: str
    size: int  # number of columns; 0 where a state lacks this unknown
    largest_step: tuple[float, ...] = (math.inf,)  # largest trusted step, one for each column or one for all
    # A stage that moves only "pose" or only "shape" fixes the blocks of the other; a block with None always moves.
    belongs_to: _PoseOrShape | None = None
    # A pose (B, 4, 4), or several (B, M, 4, 4), is multiplied by `exp` from the left; a step is added to other values.
    is_pose: bool = False
    is_bounded: bool = False  # whether `max_code` limits the magnitude

    def moved(self, value: Tensor, step: Tensor, max_code: float, max_angle: float) -> Tensor:
        """The value of a state after a step (B, size)."""
        if not self.size:
            return value
        if not self.is_pose:
            moved = value + step
            return moved.clamp(-max_code, max_code) if self.is_bounded else moved
        # The bound of the angle applies only to poses that have a trust region.
        max_angle = max_angle if math.isfinite(self.largest_step[0]) else math.inf
        flat = value.flatten(0, -3)
        return torch.bmm(se3.exp(step.reshape(-1, 6), max_angle), flat).view_as(value)


def blocks_of_car(num_codes: int, num_offsets: int) -> tuple[Block, ...]:
    """The blocks of a car that is refined alone.

    The largest steps form a trust region: a step that exceeds one of them is scaled as a whole. The offset of a rig
    changes by at most one pixel in an iteration.
    """
    return (
        Block(POSE, 6, (0.5, 0.5, 0.5, 0.15, 0.15, 0.15), "pose", is_pose=True),
        Block(CODE, num_codes, (1.0,), "shape", is_bounded=True),
        Block(OFFSET, num_offsets, (1.0,)),
    )


LARGEST_ROTATION_RAD = math.sqrt(3) * 0.15
"""A step within the trust region turns a car by at most this angle, because its three components are limited."""


class State(TensorTuple, Protocol):
    """A state is a named tuple of the poses, the shapes and the other unknowns of B cars."""

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
        """Measured minus true disparity (B, S), full-resolution pixels; S is 0 where the offset is known, else 1."""
        ...

    @property
    def unknowns(self) -> Unknowns:
        """Blocks of the tangent, one for each tensor of the state, in the order of the state."""
        ...


AnyState = TypeVar("AnyState", bound=State)
_T = TypeVar("_T")


@dataclass(frozen=True)
class Unknowns:
    """`Unknowns` are the blocks of a state, in the order of the columns of its tangent.

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
        """The columns of adjacent blocks."""
        all_names = [block.name for block in self.blocks]
        first, last = (all_names.index(name) for name in (names[0], names[-1]))
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
        """A Jacobian (..., D) by all unknowns, from a Jacobian by the blocks that a residual `sees`.

        The blocks have the order of the state. A Jacobian that already has all D columns is returned unchanged.

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
        """Move a state by a step of the tangent.

        The step gives `T_obj_cam <- exp(v, omega) T_obj_cam` and, within its bound, `code <- code + dcode`; any other
        block moves as its fields `is_pose` and `is_bounded` say.

        Args:
            state: B cars with these unknowns.
            delta: (B, D) of the blocks in their order: of a pose `(v, omega)` in metres and radians, of the code
                standard deviations, of the offset pixels.
            max_code: largest magnitude of a code component.
            max_angle: largest angle of a rotation, radians (see `se3.exp`).
        """
        steps = delta.to(state.code.dtype).split_with_sizes([block.size for block in self.blocks], dim=1)
        values = zip(self.blocks, state, steps, strict=True)
        return remade(state, (block.moved(value, step, max_code, max_angle) for block, value, step in values))

    def derivative(self, of: Callable[[AnyState], _T], state: AnyState) -> tuple[_T, _T]:
        """What a function makes of a state, tensors (B, ...), and its derivatives (B, ..., D) in forward mode.

        Each value belongs to one car, so one tangent moves all cars at once, and D batched tangents share one
        evaluation of the values.
        """

        def moved(delta: Tensor) -> tuple[_T, _T]:
            values = of(self.retract(state, delta.expand(len(state.code), self.size)))
            return values, values

        zero = torch.zeros(self.size, dtype=state.code.dtype, device=state.code.device)
        derivatives, values = torch.func.jacfwd(moved, has_aux=True)(zero)
        return values, derivatives

    def largest_steps(self, device: torch.device) -> Tensor:
        """The largest trusted step (D,) of each unknown, float64; the caller must not write to this tensor."""
        limits = [
            limit
            for b in self.blocks
            for limit in (b.largest_step * b.size if len(b.largest_step) == 1 else b.largest_step)
        ]
        return constant_like(tuple(limits), torch.empty(0, dtype=torch.float64, device=device))

    def moving(self, moves: Literal["both", "pose", "shape"], device: torch.device) -> Tensor:
        """Mask (D,) of the unknowns that a stage moves."""
        by_column = [
            moves == "both" or block.belongs_to in (None, moves) for block in self.blocks for _ in range(block.size)
        ]
        return torch.tensor(by_column, dtype=torch.bool, device=device)

    def free(self, state: State, max_code: float) -> Tensor:
        """Mask (B, D) of the unknowns that may move: a code component at its bound is a constant."""
        free = torch.ones_like(state.code[:, :1], dtype=torch.bool).expand(-1, self.size).clone()
        for block, value in zip(self.blocks, state, strict=True):
            if block.is_bounded:
                free[:, self.span(block.name)] = value.abs() < max_code
        return free
