"""This module computes central differences with Richardson extrapolation, and estimates their errors.

A function is sampled at `+-h` for a geometric sequence of steps h. Three neighbouring steps make one stencil, whose
extrapolation removes the errors of order h^2 and h^4. The stencil for an entry is chosen before any comparison, only by
values of the function. Four figures decide: the measured rounding noise; how far the derivatives from the two larger
and the two smaller steps are apart; the extrapolated jump of the slope at the centre, which is zero unless a kink lies
within the stencil; and the results of finer stencils.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

STEP_RATIO = 4.0
STEPS: tuple[float, ...] = tuple(8e-3 / STEP_RATIO**k for k in range(8))
"""These steps are in the units of the argument: metres, radians, standard deviations or pixels."""

KINK = "kink within the stencil"
UNRESOLVED = "below float64 resolution"

# Along displacements this small the function is linear far beyond its precision. Therefore the difference between its
# value at the centre and the mean of both ends is rounding.
_JITTER = 1e-11
# With fewer displacements the largest measured rounding is at times far too low, and a stencil that is too fine is
# chosen.
_NUM_JITTERS = 16
# This many displacements are evaluated in one batch.
_AT_ONCE = 14
# This is the rounding of the extrapolated jump, in units of the rounding of the values divided by the smallest step. It
# is (2 * 256 + 2 * 68 + 2) / 189 plus the rounding of the centre.
_JUMP_ROUNDING = 7.0
# Few jitters can miss the worst rounding. If two stencils seem equally good, the coarser one is safer.
_CAUTION = 10.0

Evaluate = Callable[[Tensor], Sequence[Tensor]]
"""It evaluates several functions (R,) of one displacement (D,) together; `torch.vmap` calls it."""


@dataclass(frozen=True)
class DifferenceSweep:
    """These are derivatives of one function of D unknowns with values (R,), from S steps, which make S - 2 stencils."""

    extrapolated: Tensor  # (S - 2, R, D) derivatives by Richardson extrapolation
    error: Tensor  # (S - 2, R, D) estimated error of `extrapolated`: truncation, kinks and rounding
    rounding: Tensor  # (S - 2, R, D) only the rounding part of `error`


def sweep(evaluate: Evaluate, units: Tensor) -> list[DifferenceSweep]:
    """Differentiate several functions numerically at zero displacement by each of their D unknowns.

    Args:
        evaluate: the functions.
        units: (D,) the length that a step of 1 stands for in each unknown.

    Examples:
        >>> found = sweep(lambda delta: [torch.sin(1 + delta)], torch.ones(1, dtype=torch.float64))[0]
        >>> bool(abs(found.extrapolated[2, 0, 0] - torch.cos(torch.tensor(1.0, dtype=torch.float64))) < 1e-10)
        True
    """
    generator = torch.Generator().manual_seed(0)
    jitters = torch.rand(_NUM_JITTERS, len(units), generator=generator, dtype=torch.float64).to(units) * 2 - 1
    moves = units.new_tensor(STEPS)[:, None, None] * torch.diag(units)
    deltas = torch.cat([torch.zeros_like(units)[None], _JITTER * units * jitters, moves.flatten(0, 1)])
    with warnings.catch_warnings():
        # The warning only says that an operation without batching runs one displacement after the other.
        warnings.filterwarnings("ignore", message=".*performance drop.*")
        plus, minus = (torch.func.vmap(evaluate, chunk_size=_AT_ONCE)(sign * deltas) for sign in (1, -1))
    return [_of_one_function(*ends, units) for ends in zip(plus, minus, strict=True)]


def _of_one_function(plus: Tensor, minus: Tensor, units: Tensor) -> DifferenceSweep:
    """Sweep from values (1 + `_NUM_JITTERS` + S D, R) at displacements and their negatives: zero, jitters, steps."""
    centre, jittered = plus[0], slice(1, 1 + _NUM_JITTERS)
    unsteady = 0.5 * (plus[jittered] + minus[jittered] - 2 * centre).abs().amax(dim=0)
    noise = torch.maximum(torch.finfo(units.dtype).eps * centre.abs(), unsteady)
    plus, minus = (x[jittered.stop :].view(len(STEPS), len(units), -1).mT for x in (plus, minus))
    return _extrapolate(centre, plus, minus, noise, units)


def _extrapolate(centre: Tensor, plus: Tensor, minus: Tensor, noise: Tensor, units: Tensor) -> DifferenceSweep:
    step = units.new_tensor(STEPS)[:, None, None] * units
    central = (plus - minus) / (2 * step)  # f' + O(h^2) + O(h^4)
    jump = (plus + minus - 2 * centre[:, None]) / step  # O(h) + O(h^3), and the jump of the slope at a kink
    first, second = _two_orders(central, (2, 4))
    _, extrapolated_jump = _two_orders(jump, (1, 3))
    rounding = 2 * noise[:, None] / step[2:]
    kink = (extrapolated_jump.abs() - _JUMP_ROUNDING * noise[:, None] / step[2:]).clamp_min(0)
    # The error of `second` is far below this estimate for a smooth function, but not for one with kinks.
    return DifferenceSweep(second, (first[1:] - first[:-1]).abs() + kink + rounding, rounding)


def _two_orders(values: Tensor, orders: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Values (S, ...) of falling steps without the error of the first order (S - 1, ...) and of both (S - 2, ...)."""
    first, second = (STEP_RATIO**order for order in orders)
    once = (first * values[1:] - values[:-1]) / (first - 1)
    return once, (second * once[1:] - once[:-1]) / (second - 1)


class Choice(NamedTuple):
    """This is the derivative of each entry, or the reason why there is none."""

    derivative: Tensor  # (R, D) NaN where excluded
    excluded: Mapping[str, Tensor]  # reason -> (R, D) bool, at most one reason for an entry


def choose(found: DifferenceSweep, needed: Tensor) -> Choice:
    """Choose for each entry the stencil of least estimated error that no finer stencil contradicts.

    A derivative is a limit of small steps. If the estimated errors of two stencils do not explain their difference, the
    coarser one contains a kink that its own values do not show, perhaps because there is a kink on both sides.

    Args:
        found: the sweep.
        needed: (R,) largest error that the differences may have.

    Returns:
        The derivatives and the exclusions. An entry is `UNRESOLVED` if the rounding of every stencil exceeds the needed
        error, else `KINK` if the best estimated error exceeds it. NaN values are not excluded.

    Examples:
        >>> found = sweep(lambda delta: [(delta + 1e-9).abs()], torch.ones(1, dtype=torch.float64))[0]
        >>> choose(found, torch.full((1,), 1e-6, dtype=torch.float64)).excluded[KINK]
        tensor([[True]])
    """
    ranking = (found.error + _CAUTION * found.rounding).masked_fill(_contradicted(found), torch.inf)
    best = ranking.argmin(dim=0, keepdim=True)  # a stencil with NaN is chosen if there is one
    derivative, error = (x.gather(0, best)[0] for x in (found.extrapolated, found.error))
    needed = needed[:, None]
    unresolved = (found.rounding > needed).all(dim=0)
    kink = ~unresolved & (error > needed)
    excluded = unresolved | kink
    return Choice(torch.where(excluded, torch.nan, derivative), {KINK: kink, UNRESOLVED: unresolved})


def _contradicted(found: DifferenceSweep) -> Tensor:
    """Whether stencils (S - 2, R, D) differ from a finer one by more than both errors; NaN gives False."""
    low, high = found.extrapolated - found.error, found.extrapolated + found.error
    least_high = high.flip(0).cummin(dim=0).values.flip(0)
    largest_low = low.flip(0).cummax(dim=0).values.flip(0)
    return (low > least_high) | (high < largest_low)
