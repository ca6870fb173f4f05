"""Central differences with Richardson extrapolation over a sweep of steps, and what they know of their own error.

A function is sampled at `+-h` for a geometric sequence of steps h. Three neighbouring steps make one stencil, whose
extrapolation removes the errors of order h^2 and h^4. Which stencil serves an entry is decided before any comparison,
by values of the function alone: its rounding noise (measured), how far the derivatives from its two larger and its two
smaller steps are apart, the jump of the slope between both sides of the centre, extrapolated likewise, which is zero
unless a kink lies within the stencil, and what finer stencils say.
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
"""Metres, radians, standard deviations, pixels: the units of the argument."""

KINK = "kink within the stencil"
UNRESOLVED = "below float64 resolution"

# Displacements so small that the function is linear along them, to many digits more than it has: what its value at the
# centre lacks to the mean of both ends is rounding.
_JITTER = 1e-11
# With few of them the largest is at times far below the rounding there is, and a stencil too fine is taken.
_NUM_JITTERS = 16
# Displacements evaluated in one batch.
_AT_ONCE = 14
# Rounding of the extrapolated jump, in roundings of the values over the smallest step: (2 * 256 + 2 * 68 + 2) / 189,
# and the centre's.
_JUMP_ROUNDING = 7.0
# Few jitters can miss the worst rounding: of two stencils that seem as good the coarser one is the safer one.
_CAUTION = 10.0

Evaluate = Callable[[Tensor], Sequence[Tensor]]
"""Several functions (R,) of one displacement (D,), evaluated together because they share work; by `torch.vmap`."""


@dataclass(frozen=True)
class DifferenceSweep:
    """Derivatives of one function of D unknowns with values (R,), from S steps, which make S - 2 stencils."""

    extrapolated: Tensor  # (S - 2, R, D) Richardson's
    error: Tensor  # (S - 2, R, D) estimated error of those: truncation, kinks and rounding
    rounding: Tensor  # (S - 2, R, D) the rounding part alone


def sweep(evaluate: Evaluate, units: Tensor) -> list[DifferenceSweep]:
    """Difference several functions at zero displacement by each of their D unknowns.

    Args:
        evaluate: the functions.
        units: (D,) the length that a step of one stands for in each unknown.

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
        # An operation that knows of no batch runs one displacement after the other, which is all that is said.
        warnings.filterwarnings("ignore", message=".*performance drop.*")
        plus, minus = (torch.func.vmap(evaluate, chunk_size=_AT_ONCE)(sign * deltas) for sign in (1, -1))
    return [_of_one_function(*ends, units) for ends in zip(plus, minus, strict=True)]


def _of_one_function(plus: Tensor, minus: Tensor, units: Tensor) -> DifferenceSweep:
    """From values (1 + `_NUM_JITTERS` + S D, R) at displacements and at their negatives: none, jitters, steps."""
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
    # Of a smooth function the second order is better than that by far; of one with kinks it is not.
    return DifferenceSweep(second, (first[1:] - first[:-1]).abs() + kink + rounding, rounding)


def _two_orders(values: Tensor, orders: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Values (S, ...) of falling steps without their error of one order (S - 1, ...), and of both (S - 2, ...)."""
    first, second = (STEP_RATIO**order for order in orders)
    once = (first * values[1:] - values[:-1]) / (first - 1)
    return once, (second * once[1:] - once[:-1]) / (second - 1)


class Choice(NamedTuple):
    """The derivative of each entry, or the reason why there is none."""

    derivative: Tensor  # (R, D) NaN where excluded
    excluded: Mapping[str, Tensor]  # reason -> (R, D) bool, no entry under two


def choose(found: DifferenceSweep, needed: Tensor) -> Choice:
    """Take for each entry the stencil of least estimated error that no finer one contradicts.

    A derivative is a limit of small steps: where the errors that a stencil and a finer one estimate of themselves do
    not explain their difference, the coarser one has a kink within it, on both sides perhaps, that its own values do
    not show.

    Args:
        found: the sweep.
        needed: (R,) error that the differences must reach.

    Returns:
        The derivatives and the exclusions: under `UNRESOLVED` where the rounding of no stencil permits the error, else
        under `KINK` where the best estimate is worse. A function that is no number is not excluded.

    Examples:
        >>> found = sweep(lambda delta: [(delta + 1e-9).abs()], torch.ones(1, dtype=torch.float64))[0]
        >>> choose(found, torch.full((1,), 1e-6, dtype=torch.float64)).excluded[KINK]
        tensor([[True]])
    """
    ranking = (found.error + _CAUTION * found.rounding).masked_fill(_contradicted(found), torch.inf)
    best = ranking.argmin(dim=0, keepdim=True)  # that of NaN, if there is one
    derivative, error = (x.gather(0, best)[0] for x in (found.extrapolated, found.error))
    needed = needed[:, None]
    unresolved = (found.rounding > needed).all(dim=0)
    kink = ~unresolved & (error > needed)
    excluded = unresolved | kink
    return Choice(torch.where(excluded, torch.nan, derivative), {KINK: kink, UNRESOLVED: unresolved})


def _contradicted(found: DifferenceSweep) -> Tensor:
    """Which stencils (S - 2, R, D) are further from a finer one than both errors allow; of no number none is."""
    low, high = found.extrapolated - found.error, found.extrapolated + found.error
    least_high = high.flip(0).cummin(dim=0).values.flip(0)
    largest_low = low.flip(0).cummax(dim=0).values.flip(0)
    return (low > least_high) | (high < largest_low)
