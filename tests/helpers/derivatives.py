"""Derivatives by the tangent of the state, by central differences and by autograd."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from directshape_torch.geometry import se3
from directshape_torch.terms.cars import CarState


def moved(state: CarState, delta: Tensor) -> CarState:
    """The state at `delta` (B, D) of its own tangent, by the definition of CONVENTIONS.md; differentiable."""
    last, size = 6, []
    for part in state[1:4]:
        size.append(delta[:, last : last + part.shape[1]])
        last += part.shape[1]
    others = (x + dx for x, dx in zip(state[1:4], size, strict=True))
    T_obj_next = se3.exp(delta[:, last:].unflatten(1, (state.T_obj_next.shape[1], 6))) @ state.T_obj_next
    return CarState(se3.exp(delta[:, :6]) @ state.T_obj_cam, *others, T_obj_next)


def tangent_of(state: CarState) -> Tensor:
    """Zero tangent vectors (B, D)."""
    return state.code.new_zeros(len(state.code), state.num_unknowns)


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
