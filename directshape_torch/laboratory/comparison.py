"""This module compares three Jacobians: relative errors of entries, exclusions with reasons, and bounds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from directshape_torch.laboratory.differences import KINK, DifferenceSweep, choose, sweep
from directshape_torch.laboratory.experiments import Experiment, Subject

BOUNDS: Mapping[str, float] = {"analytic-autograd": 1e-9, "analytic-numeric": 1e-6}
"""These are the largest permitted errors of an entry in float64, relative to the norm of its row."""
MAX_EXCLUDED_SHARE_TYPICAL = 0.02
MAX_VALUE_ERROR = 1e-9
"""This bounds the relative difference between the two ways in which a term computes its residuals."""

# Differences must have an error of at most this share of the bound that they decide.
_RESOLUTION_SHARE = 0.25
# Only a kink explains a larger estimated error of a derivative than this share of the derivative.
_KINK_SHARE = 0.1
# A row is compared relative to its norm. Rows shorter than a millionth of the longest row of their regime (a ray deep
# inside the mask, a neighbour on a white wall) contain only rounding, so they are compared relative to that millionth.
_FLAT_SHARE = 1e-6


@dataclass(frozen=True)
class Comparison:
    """This is the comparison of one subject in one regime."""

    name: str  # of the term or of its gradient
    regime: str  # of the state
    entries: int  # rows times unknowns
    compared: int  # entries that differences could judge
    excluded: Mapping[str, int]  # by reason, entries that differences could not judge
    errors: Mapping[str, float]  # the largest of each pair of `BOUNDS`, relative
    value_error: float = 0.0  # see `Subject.value_error`

    @property
    def excluded_share(self) -> float:
        return sum(self.excluded.values()) / self.entries if self.entries else 0.0

    def broken_bounds(self) -> list[str]:
        """One sentence for each bound that does not hold.

        Examples:
            >>> bad = Comparison("warp", "typical", 2, 2, {}, {"analytic-numeric": 0.5})
            >>> bad.broken_bounds()
            ['warp, typical: analytic-numeric error 5.0e-01 above 1e-06']
        """
        broken = [
            f"{self.name}, {self.regime}: {pair} error {error:.1e} above {BOUNDS[pair]:.0e}"
            for pair, error in self.errors.items()
            if not error <= BOUNDS[pair]
        ]
        if not self.value_error <= MAX_VALUE_ERROR:
            broken.append(f"{self.name}, {self.regime}: residual and linear give values {self.value_error:.1e} apart")
        if self.regime == "typical" and self.excluded_share >= MAX_EXCLUDED_SHARE_TYPICAL:
            broken.append(f"{self.name}, typical: {100 * self.excluded_share:.1f} percent of the entries excluded")
        return broken


def compare(experiment: Experiment, regime: str) -> list[Comparison]:
    """Differentiate the subjects of an experiment numerically and compare their three Jacobians, float64."""
    found = sweep(experiment.evaluate, experiment.units)
    return [_compare(s, f, regime) for s, f in zip(experiment.subjects, found, strict=True)]


def _compare(subject: Subject, found: DifferenceSweep, regime: str) -> Comparison:
    norm = subject.norm
    moving = norm != 0  # includes NaN, whose errors are NaN and break the bounds
    finite = norm[moving & norm.isfinite()]
    longest = finite.max() if len(finite) else norm.new_ones(())
    scale = norm.clamp_min(float(_FLAT_SHARE * longest))
    choice = choose(found, _RESOLUTION_SHARE * BOUNDS["analytic-numeric"] * scale)
    # Every entry without a reason for exclusion is judged, so a difference that is NaN breaks its bound.
    judged = moving[:, None] & ~torch.stack(list(choice.excluded.values())).any(dim=0)
    excluded = {reason: int((e & moving[:, None]).sum()) for reason, e in choice.excluded.items()}
    constant_errors, kinks = _rows_that_should_be_constant(found, ~moving)
    excluded[KINK] += kinks
    by_autograd, by_differences = (
        (subject.analytic - other).abs() / scale[:, None] for other in (subject.autograd, choice.derivative)
    )
    return Comparison(
        name=subject.name,
        regime=regime,
        entries=subject.analytic.numel(),
        compared=int(judged.sum()) + len(constant_errors),
        excluded={reason: n for reason, n in excluded.items() if n},
        errors={
            "analytic-autograd": _largest(by_autograd[moving]),
            "analytic-numeric": _largest(torch.cat([by_differences[judged], constant_errors])),
        },
        value_error=subject.value_error,
    )


def _rows_that_should_be_constant(found: DifferenceSweep, constant: Tensor) -> tuple[Tensor, int]:
    """Check that the differences of rows with zero Jacobians, which have no norm to compare with, are only rounding.

    They are judged at the smallest stencil, where a kink is least likely. An entry beyond four times its rounding
    counts as an infinite relative error.

    Returns:
        The errors of the entries without a kink in the smallest stencil, and the number of entries with one.
    """
    derivative, error, rounding = (x[-1][constant] for x in (found.extrapolated, found.error, found.rounding))
    still = derivative.abs() <= 4 * rounding
    kink = ~still & (error - rounding > _KINK_SHARE * derivative.abs())
    return torch.where(still, 0.0, torch.inf)[~kink].to(derivative.dtype), int(kink.sum())


def _largest(errors: Tensor) -> float:
    """The largest error; NaN if any is NaN, and zero if there are none."""
    return float(errors.max()) if errors.numel() else 0.0
