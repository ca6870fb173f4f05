"""This module computes derivatives by the tangent of the state, by central differences and by autograd."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from directshape_torch.geometry import se3
from directshape_torch.solver.problem import remade
from directshape_torch.state.unknowns import AnyState, State


def moved(state: AnyState, delta: Tensor) -> AnyState:
    """The state at `delta` (B, D) of its own tangent, by the definition of CONVENTIONS.md; differentiable.

    Poses are moved by `exp` from the left, other unknowns by addition.
    """
    first, parts = 0, []
    for value in state:
        size = 6 * value[0].numel() // 16 if value.shape[-2:] == (4, 4) else value.shape[1]
        step = delta[:, first : first + size]
        moves = value.shape[-2:] == (4, 4)
        parts.append(se3.exp(step.reshape(*value.shape[:-2], 6)) @ value if moves else value + step)
        first += size
    return remade(state, parts)


def tangent_of(state: State) -> Tensor:
    """Zero tangent vectors (B, D)."""
    return state.code.new_zeros(len(state.code), state.unknowns.size)


def central_differences(function: Callable[[Tensor], Tensor], at: Tensor, step: float = 1e-6) -> Tensor:
    """`d function / d at`, shape (*function, *at), of any function of one tensor."""
    columns = []
    for i in range(at.numel()):
        offset = torch.zeros_like(at).reshape(-1)
        offset[i] = step
        offset = offset.view_as(at)
        columns.append((function(at + offset) - function(at - offset)) / (2 * step))
    value = function(at)
    if not columns:
        return value.new_zeros(*value.shape, *at.shape)
    return torch.stack(columns, dim=-1).reshape(*value.shape, *at.shape)


def relative_error(a: Tensor, b: Tensor) -> float:
    """Largest difference, relative to the largest magnitude."""
    return float((a - b).abs().max() / b.abs().max().clamp_min(1e-300))
