"""Central differences with Richardson extrapolation over a sweep of steps, and where their stencils meet kinks.

A function is sampled at `+-h` for a geometric sequence of steps h. Three neighbouring steps make one stencil, whose
extrapolation removes the errors of order h^2 and h^4. Which stencil serves an entry is decided before any comparison:
from the rounding noise of the function (measured), from the kinks that its branch ids reveal, and from the error that
the extrapolation estimates of itself.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

STEP_RATIO = 4.0
STEPS: tuple[float, ...] = tuple(8e-3 / STEP_RATIO**k for k in range(8))
"""Metres, radians, standard deviations, pixels: the units of the argument."""

# Displacements so small that the function is linear along them, to many digits more than it has: what its value at the
# centre lacks to the mean of both ends is rounding.
_JITTER = 1e-11
# With few of them the largest is at times far below the rounding there is, and a stencil too fine is taken.
_NUM_JITTERS = 16


class Probe(NamedTuple):
    """A function at one point of its argument, with what tells on which smooth piece of itself it is."""

    value: Tensor  # (R,)
    branches: Mapping[str, Tensor]  # rule -> integer ids (R,) or (R, k)


Evaluate = Callable[[Tensor], Sequence[Probe]]
"""Several functions of one displacement (D,), evaluated together because they share work."""


@dataclass(frozen=True)
class DifferenceSweep:
    """Derivatives of one function of D unknowns with values (R,), from S steps and S - 2 stencils.

    Attributes:
        value: (R,) at the centre.
        noise: (R,) rounding noise of the value.
        central: (S, R, D) plain central differences.
        extrapolated: (S - 2, R, D) Richardson's.
        error: (S - 2, R, D) estimated error of those, truncation and rounding.
        rounding: (S - 2, R, D) the rounding part alone.
        crossed: for each rule (S - 2, R, D) bool: a kink of that rule lies within the stencil.
    """

    value: Tensor
    noise: Tensor
    central: Tensor
    extrapolated: Tensor
    error: Tensor
    rounding: Tensor
    crossed: Mapping[str, Tensor]


def sweep(evaluate: Evaluate, units: Tensor, seed: int = 0) -> list[DifferenceSweep]:
    """Difference several functions at zero displacement by each of their D unknowns.

    Args:
        evaluate: the functions.
        units: (D,) the length that a step of one stands for in each unknown.
        seed: of the jitter that measures the noise.

    Example:
        >>> def sine(delta):
        ...     return [Probe(torch.sin(1 + delta), {})]
        >>> found = sweep(sine, torch.ones(1, dtype=torch.float64))[0]
        >>> bool(abs(found.extrapolated[2, 0, 0] - torch.cos(torch.tensor(1.0, dtype=torch.float64))) < 1e-10)
        True
    """
    zero = torch.zeros_like(units)
    centre = evaluate(zero)
    noise = _noise(evaluate, centre, units, seed)
    columns = [[_column(evaluate, centre, units, i, step) for i in range(len(units))] for step in STEPS]
    sweeps = []
    for j, probe in enumerate(centre):
        central = torch.stack([torch.stack([c[j][0] for c in row], dim=-1) for row in columns])
        crossed = {
            rule: torch.stack([torch.stack([c[j][1][rule] for c in row], dim=-1) for row in columns])
            for rule in probe.branches
        }
        sweeps.append(_extrapolate(probe.value, noise[j], central, crossed, units))
    return sweeps


def _noise(evaluate: Evaluate, centre: Sequence[Probe], units: Tensor, seed: int) -> list[Tensor]:
    generator = torch.Generator().manual_seed(seed)
    eps = torch.finfo(units.dtype).eps
    noise = [eps * probe.value.abs() for probe in centre]
    for _ in range(_NUM_JITTERS):
        direction = torch.rand(len(units), generator=generator, dtype=torch.float64).to(units) * 2 - 1
        ends = [evaluate(sign * _JITTER * units * direction) for sign in (1, -1)]
        for j, (plus, minus) in enumerate(zip(*ends, strict=True)):
            noise[j] = torch.maximum(noise[j], 0.5 * (plus.value + minus.value - 2 * centre[j].value).abs())
    return noise


def _column(
    evaluate: Evaluate, centre: Sequence[Probe], units: Tensor, unknown: int, step: float
) -> list[tuple[Tensor, dict[str, Tensor]]]:
    """For each function its central difference (R,) by one unknown, and for each rule whether an end left its piece."""
    delta = torch.zeros_like(units)
    delta[unknown] = step * units[unknown]
    ends = [evaluate(delta), evaluate(-delta)]
    result = []
    for plus, minus, middle in zip(*ends, centre, strict=True):
        crossed = {
            rule: _differs(plus.branches[rule], ids) | _differs(minus.branches[rule], ids)
            for rule, ids in middle.branches.items()
        }
        result.append(((plus.value - minus.value) / (2 * delta[unknown]), crossed))
    return result


def _differs(a: Tensor, b: Tensor) -> Tensor:
    return (a != b) if a.ndim == 1 else (a != b).flatten(1).any(dim=1)


def _extrapolate(
    value: Tensor, noise: Tensor, central: Tensor, crossed: Mapping[str, Tensor], units: Tensor
) -> DifferenceSweep:
    first = (STEP_RATIO**2 * central[1:] - central[:-1]) / (STEP_RATIO**2 - 1)
    second = (STEP_RATIO**4 * first[1:] - first[:-1]) / (STEP_RATIO**4 - 1)
    smallest = units.new_tensor(STEPS[2:])[:, None] * units
    rounding = 2 * noise[None, :, None] / smallest[:, None, :]
    error = (second - first[1:]).abs() + rounding
    # A kink at a distance x from the centre shows at every step beyond x: the larger ones inherit it.
    within = {rule: c.flip(0).cumsum(0).flip(0)[:-2] > 0 for rule, c in crossed.items()}
    return DifferenceSweep(value, noise, central, second, error, rounding, within)


class Choice(NamedTuple):
    """The stencil that serves each entry, or the rule that excludes it."""

    derivative: Tensor  # (R, D) NaN where excluded
    excluded: Mapping[str, Tensor]  # rule -> (R, D) bool, no entry under two rules


UNRESOLVED = "below float64 resolution"


def choose(found: DifferenceSweep, needed: Tensor) -> Choice:
    """Take for each entry the stencil of least estimated error among those without a kink.

    Args:
        found: the sweep.
        needed: (R,) error that the differences must be able to reach, by rounding alone.

    Returns:
        The derivatives and the exclusions. An entry is excluded under a rule when a kink of that rule lies within the
        smallest stencil whose rounding permits the needed error; under `UNRESOLVED` when no stencil permits it.

    Example:
        >>> def corner(delta):
        ...     x = delta + 1e-9
        ...     return [Probe(x.abs(), {"corner": (x > 0).long()})]
        >>> found = sweep(corner, torch.ones(1, dtype=torch.float64))[0]
        >>> choose(found, torch.full((1,), 1e-6, dtype=torch.float64)).excluded["corner"]
        tensor([[True]])
    """
    precise = found.rounding <= needed[None, :, None]
    kink = torch.zeros_like(precise)
    for crossed in found.crossed.values():
        kink = kink | crossed
    fit = precise & ~kink
    infinity = torch.full_like(found.error, torch.inf)
    best = torch.where(fit, found.error, infinity).argmin(dim=0, keepdim=True)
    derivative = found.extrapolated.gather(0, best)[0]
    served = fit.any(dim=0)
    resolvable = precise.any(dim=0)
    excluded = {UNRESOLVED: ~resolvable}
    # The smallest sufficient stencil is the last one in the order of falling steps.
    last = (precise.long() * torch.arange(1, len(precise) + 1)[:, None, None]).argmax(dim=0, keepdim=True)
    left = resolvable & ~served
    for rule, crossed in found.crossed.items():
        by_rule = left & crossed.gather(0, last)[0]
        excluded[rule] = by_rule
        left = left & ~by_rule
    assert not bool(left.any())
    return Choice(torch.where(served, derivative, torch.full_like(derivative, torch.nan)), excluded)
