"""Three Jacobians against one another: relative errors of entries, exclusions by rule, bounds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from directshape_torch.laboratory.differences import STEPS, UNRESOLVED, DifferenceSweep, choose, sweep
from directshape_torch.laboratory.subjects import Experiment, Subject

PAIRS = ("analytic-autograd", "analytic-numeric", "autograd-numeric")
BOUNDS: Mapping[str, float] = {"analytic-autograd": 1e-9, "analytic-numeric": 1e-6, "autograd-numeric": 1e-6}
"""Largest permitted error of an entry in float64, relative to the norm of its row."""
MAX_EXCLUDED_SHARE_TYPICAL = 0.02

# Differences must be able to resolve a quarter of the bound that they are to decide.
_RESOLUTION_SHARE = 0.25
# A row is compared relative to its norm, but rows shorter than a millionth of the longest of their regime (a ray deep
# inside the mask, a neighbour on a white wall) relative to that millionth: rounding of their parts is all they are.
FLAT_SHARE = 1e-6


@dataclass(frozen=True)
class PairError:
    """Relative errors of one pair of Jacobians."""

    maximum: float
    percentile_999: float


@dataclass(frozen=True)
class StepCurve:
    """Error of numeric differences against autograd over the step: the V-shape. Relative to the row's norm."""

    steps: tuple[float, ...]
    central_median: tuple[float, ...]
    central_999: tuple[float, ...]
    extrapolated_steps: tuple[float, ...]
    extrapolated_median: tuple[float, ...]


@dataclass(frozen=True)
class Comparison:
    """One subject in one regime.

    Attributes:
        name: of the factor or term.
        regime: of the state.
        entries: of usable rows, rows times unknowns.
        compared: entries that differences could judge.
        excluded: by rule, the entries that they could not.
        skipped_rows: rows that the residual's own skip rules make constant.
        zero_rows: usable rows whose Jacobian is exactly zero.
        flat_rows: further usable rows so short that they are compared with `FLAT_SHARE` of the longest.
        errors: for each pair.
        curve: of the numeric differences; None where there is nothing to draw.
    """

    name: str
    regime: str
    entries: int
    compared: int
    excluded: Mapping[str, int]
    skipped_rows: int
    zero_rows: int
    flat_rows: int
    errors: Mapping[str, PairError]
    curve: StepCurve | None = field(repr=False, default=None)

    @property
    def excluded_share(self) -> float:
        return sum(self.excluded.values()) / self.entries if self.entries else 0.0

    def broken_bounds(self) -> list[str]:
        """One sentence for each bound that does not hold.

        Example:
            >>> bad = Comparison("warp", "typical", 2, 2, {}, 0, 0, 0, {"analytic-numeric": PairError(0.5, 0.5)})
            >>> bad.broken_bounds()
            ['warp, typical: analytic-numeric error 5.0e-01 above 1e-06']
        """
        broken = [
            f"{self.name}, {self.regime}: {pair} error {error.maximum:.1e} above {BOUNDS[pair]:.0e}"
            for pair, error in self.errors.items()
            if not error.maximum <= BOUNDS[pair]
        ]
        if self.regime == "typical" and self.excluded_share >= MAX_EXCLUDED_SHARE_TYPICAL:
            broken.append(f"{self.name}, typical: {100 * self.excluded_share:.1f} percent of the entries excluded")
        return broken


def compare(experiment: Experiment, regime: str) -> list[Comparison]:
    """Difference the subjects of an experiment and compare their three Jacobians, float64."""
    found = sweep(experiment.evaluate, experiment.units)
    return [_compare(s, f, regime) for s, f in zip(experiment.subjects, found, strict=True)]


def _compare(subject: Subject, found: DifferenceSweep, regime: str) -> Comparison:
    usable = subject.usable
    norm = subject.norm
    moving = usable & (norm != 0)  # NaN among them: its errors are NaN and break the bounds
    finite = norm[moving & norm.isfinite()]
    longest = finite.max() if len(finite) else norm.new_ones(())
    scale = norm.clamp_min(float(FLAT_SHARE * longest))
    choice = choose(found, _RESOLUTION_SHARE * BOUNDS["analytic-numeric"] * scale)
    numeric = choice.derivative
    # Everything that no rule excludes is judged: a difference that is no number breaks its bound.
    judged = moving[:, None] & ~torch.stack(list(choice.excluded.values())).any(dim=0)
    excluded = {rule: int((e & moving[:, None]).sum()) for rule, e in choice.excluded.items()}
    difference = {
        "analytic-autograd": (subject.analytic - subject.autograd).abs(),
        "analytic-numeric": (subject.analytic - numeric).abs(),
        "autograd-numeric": (subject.autograd - numeric).abs(),
    }
    pairs = {
        pair: (d / scale[:, None])[moving[:, None].expand_as(d) if pair == "analytic-autograd" else judged]
        for pair, d in difference.items()
    }
    constant = usable & (norm == 0)
    constant_errors, constant_excluded = _rows_that_should_be_constant(found, constant)
    pairs = {p: e if p == "analytic-autograd" else torch.cat([e, constant_errors]) for p, e in pairs.items()}
    excluded = {rule: n + constant_excluded.get(rule, 0) for rule, n in excluded.items()}
    return Comparison(
        name=subject.name,
        regime=regime,
        entries=int(usable.sum()) * subject.analytic.shape[1],
        compared=int(judged.sum()) + len(constant_errors),
        excluded={rule: n for rule, n in excluded.items() if n},
        skipped_rows=int((~usable).sum()),
        zero_rows=int(constant.sum()),
        flat_rows=int((moving & (norm < scale)).sum()),
        errors={pair: _pair_error(e) for pair, e in pairs.items()},
        curve=_curve(subject, found, moving, scale[:, None]),
    )


def _rows_that_should_be_constant(found: DifferenceSweep, constant: Tensor) -> tuple[Tensor, dict[str, int]]:
    """Rows whose Jacobians are zero have no norm to compare with: their differences must be rounding alone.

    Judged at the smallest stencil, where a kink is least likely; an entry beyond four times its rounding is an
    infinite relative error.

    Returns:
        The errors of the entries without a kink there, and the number of the others by rule.
    """
    judged = constant[:, None].expand_as(found.extrapolated[-1])
    excluded = {}
    for rule, crossed in found.crossed.items():
        excluded[rule] = int((judged & crossed[-1]).sum())
        judged = judged & ~crossed[-1]
    still = found.extrapolated[-1].abs() <= 4 * found.rounding[-1]
    return torch.where(still, 0.0, torch.inf)[judged].to(found.value.dtype), excluded


def _pair_error(error: Tensor) -> PairError:
    if not len(error):
        return PairError(0.0, 0.0)
    if error.isnan().any():
        return PairError(float("nan"), float("nan"))
    return PairError(float(error.max()), quantile(error, 0.999))


def quantile(values: Tensor, share: float) -> float:
    """The value that a share of all values does not exceed, without the size limit of `torch.quantile`.

    Example:
        >>> quantile(torch.arange(1001.0), 0.999)
        999.0
    """
    if not len(values):
        return float("nan")
    rank = min(len(values) - 1, round(share * (len(values) - 1)))
    return float(values.sort().values[rank])


def _curve(subject: Subject, found: DifferenceSweep, moving: Tensor, scale: Tensor) -> StepCurve | None:
    if not bool(moving.any()):
        return None
    central = [((c - subject.autograd).abs() / scale)[moving].flatten() for c in found.central]
    extrapolated = [((e - subject.autograd).abs() / scale)[moving].flatten() for e in found.extrapolated]
    return StepCurve(
        STEPS,
        tuple(quantile(e, 0.5) for e in central),
        tuple(quantile(e, 0.999) for e in central),
        STEPS[2:],
        tuple(quantile(e, 0.5) for e in extrapolated),
    )


__all__ = ["BOUNDS", "PAIRS", "UNRESOLVED", "Comparison", "PairError", "StepCurve", "compare", "quantile"]
