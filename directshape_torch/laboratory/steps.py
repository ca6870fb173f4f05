"""How far a Gauss-Newton step moves when something about a Jacobian changes: the figure that matters."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.energy.car_problem import CarProblem
from directshape_torch.energy.term import TermLinearisation
from directshape_torch.solver.damped_solve import damped_step, limit_step


class StepShift(NamedTuple):
    """Difference of two steps of each car."""

    trust_region_share: Tensor  # (B,) largest change of an unknown as a share of its trust region
    metres: Tensor  # (B,)
    degrees: Tensor  # (B,)
    turned_deg: Tensor  # (B,) angle between the two steps, each unknown measured by its trust region


def gauss_newton_step(problem: CarProblem, parts: Sequence[TermLinearisation]) -> Tensor:
    """The first step (B, D) from these linearisations as the solver takes it where it does not over-relax."""
    gradient = torch.stack([p.gradient for p in parts]).sum(dim=0)
    hessian = torch.stack([p.hessian for p in parts]).sum(dim=0)
    damping = torch.full_like(gradient[:, 0], problem.config.solver.initial_damping)
    step, _ = damped_step(hessian, gradient, damping)
    return limit_step(step, problem.step_limits().to(step))


def step_shift(problem: CarProblem, step: Tensor, other: Tensor) -> StepShift:
    """How far `other` (B, D) is from `step`."""
    difference = other - step
    limits = problem.step_limits().to(step)
    a, b = step / limits, other / limits
    cosine = (a * b).sum(dim=1) / (a.norm(dim=1) * b.norm(dim=1)).clamp_min(1e-300)
    return StepShift(
        (difference.abs() / limits).amax(dim=1),
        difference[:, :3].norm(dim=1),
        torch.rad2deg(difference[:, 3:6].norm(dim=1)),
        torch.where((a != b).any(dim=1), torch.rad2deg(torch.arccos(cosine.clamp(-1, 1))), torch.zeros_like(cosine)),
    )


def largest(values: Tensor) -> float:
    """The largest of the finite values, NaN where there are none.

    Example:
        >>> largest(torch.tensor([1.0, math.nan, 3.0]))
        3.0
    """
    finite = values[values.isfinite()]
    return float(finite.max()) if len(finite) else math.nan


def median(values: Tensor) -> float:
    """The median of the finite values, NaN where there are none.

    Example:
        >>> median(torch.tensor([1.0, math.nan, 3.0, 9.0]))
        3.0
    """
    finite = values[values.isfinite()]
    return float(finite.median()) if len(finite) else math.nan
