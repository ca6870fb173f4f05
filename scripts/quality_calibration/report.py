"""The calibration in Markdown and in two pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from directshape_torch.diagnosis.trust_model import LogisticHead
from directshape_torch.files.atomic_files import write_bytes
from directshape_torch.io.figure_files import figure_png, new_figure
from quality_calibration.fit import SigmaScales
from quality_calibration.judgement import (
    ReliabilityBin,
    Thresholds,
    coverage,
    discrimination,
    is_kept,
    is_worse,
    policy,
    reliability,
)
from quality_calibration.observations import Array, Observations

_SIGMA_NAMES = ("along the ray", "across it", "vertical", "heading")


@dataclass(frozen=True)
class Judged:
    """Cars with the figures that a model which has not seen them gives.

    Attributes:
        name: of the cars.
        observations: N cars.
        better, not_worse: (N,) probabilities.
        errors, sigmas: (N, 4) along the viewing ray, across it, vertically and of the heading.
    """

    name: str
    observations: Observations
    better: Array
    not_worse: Array
    errors: Array
    sigmas: Array

    @property
    def probabilities(self) -> Array:
        return np.column_stack([self.better, self.not_worse])

    @property
    def is_better(self) -> NDArray[np.bool_]:
        return np.asarray(self.observations.iou_after > self.observations.iou_before)

    @property
    def is_not_worse(self) -> NDArray[np.bool_]:
        return ~is_worse(self.observations)

    def where(self, condition: NDArray[np.bool_], name: str) -> Judged:
        """Some of the cars."""
        parts = (self.better, self.not_worse, self.errors, self.sigmas)
        return Judged(name, self.observations.where(condition), *(part[condition] for part in parts))


def head_table(heads: Sequence[tuple[str, LogisticHead]]) -> str:
    """Weights of standardised columns, the means and scales that standardise them."""
    lines = ["| head | column | weight | mean | scale |", "|---|---|---|---|---|"]
    for name, head in heads:
        lines.append(f"| {name} | (bias) | {head.bias:+.2f} | | |")
        for column, weight, mean, scale in zip(head.columns, head.weights, head.means, head.scales, strict=True):
            lines.append(f"| | `{column}` | {weight:+.2f} | {mean:.3g} | {scale:.3g} |")
    return "\n".join(lines)


def discrimination_table(cars: Sequence[Judged]) -> str:
    """Log loss beside that of the base rate, and the area under the ROC curve."""
    lines = [
        "| cars | n | head | came true | predicted, mean | log loss (base rate alone) | AUC |",
        "|---|---|---|---|---|---|---|",
    ]
    for c in cars:
        for head, probability, outcome in (
            ("better", c.better, c.is_better),
            ("not worse", c.not_worse, c.is_not_worse),
        ):
            d = discrimination(probability, outcome)
            lines.append(
                f"| {c.name} | {len(outcome)} | {head} | {100 * outcome.mean():.1f} % | "
                f"{100 * probability.mean():.1f} % | {d.log_loss:.3f} ({d.base_log_loss:.3f}) | {d.auc:.2f} |"
            )
    return "\n".join(lines)


def reliability_table(name: str, bins: Sequence[ReliabilityBin]) -> str:
    """Predicted against observed."""
    lines = [f"| {name}: predicted | observed | cars |", "|---|---|---|"]
    for b in bins:
        observed = f"{100 * b.observed:.1f} % [{100 * b.low:.1f}, {100 * b.high:.1f}]"
        lines.append(f"| {100 * b.predicted:.1f} % | {observed} | {b.count} |")
    return "\n".join(lines)


def policy_table(cars: Sequence[Judged], policies: Sequence[Thresholds]) -> str:
    """What thresholds cost and save."""
    lines = [
        "| cars | better | not worse | results kept | made worse by 0.05 | mean BEV IoU (input) |",
        "|---|---|---|---|---|---|",
    ]
    for c in cars:
        for thresholds in policies:
            p = policy(c.observations, is_kept(c.probabilities, thresholds))
            before = f" ({c.observations.iou_before.mean():.3f})" if thresholds == policies[0] else ""
            lines.append(
                f"| {c.name} | {thresholds.better:g} | {thresholds.not_worse:g} | {100 * p.kept:.1f} % | "
                f"{100 * p.worse:.1f} % | {p.iou:.3f}{before} |"
            )
    return "\n".join(lines)


def coverage_table(cars: Sequence[Judged]) -> str:
    """Shares of errors within one and two sigmas."""
    header = "| cars | " + " | ".join(f"{n}: 1 sigma, 2 sigma (median)" for n in _SIGMA_NAMES) + " |"
    lines = [header, "|" + "---|" * 5]
    for c in cars:
        one, two = coverage(c.errors, c.sigmas)
        medians = np.median(c.sigmas, axis=0) * np.array([1, 1, 1, 180 / np.pi])
        units = ("m", "m", "m", "deg")
        cells = [
            f"{100 * a:.0f} %, {100 * b:.0f} % ({m:.2f} {u})"
            for a, b, m, u in zip(one, two, medians, units, strict=True)
        ]
        lines.append(f"| {c.name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def sigma_line(scales: SigmaScales) -> str:
    """Factors and floors in words."""
    pairs = zip(_SIGMA_NAMES, scales.factors, scales.floors, ("m", "m", "m", "rad"), strict=True)
    return "; ".join(f"{name}: factor {factor:.2f}, floor {floor:.3f} {unit}" for name, factor, floor, unit in pairs)


def plot_reliability(path: Path, cars: Sequence[Judged], bins: Sequence[int]) -> None:
    """Predicted against observed for both heads, 95 % intervals over frames."""
    figure = new_figure(9, 4.8, "the reliability diagram")
    axes = figure.subplots(1, 2)
    heads = (("better than the input", "better", "is_better"), ("not worse by 0.05", "not_worse", "is_not_worse"))
    for axis, (title, probability, outcome) in zip(axes, heads, strict=True):
        axis.plot([0, 1], [0, 1], color="0.7", linewidth=1)
        for c, num_bins in zip(cars, bins, strict=True):
            found = reliability(getattr(c, probability), getattr(c, outcome), c.observations.group, num_bins)
            x, y = np.array([b.predicted for b in found]), np.array([b.observed for b in found])
            spread = np.maximum(0, [y - [b.low for b in found], [b.high for b in found] - y])
            axis.errorbar(x, y, spread, marker="o", capsize=3, linewidth=1.2, label=f"{c.name} ({len(c.better)})")
        axis.set(title=title, xlabel="predicted probability", ylabel="share that came true")
        axis.set_aspect("equal")
    axes[0].set(xlim=(0, 1.02), ylim=(0, 1.02))
    axes[1].set(xlim=(0.5, 1.02), ylim=(0.5, 1.02))
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=8)
    write_bytes(path, figure_png(figure))


def plot_policy(path: Path, cars: Sequence[Judged], chosen: Thresholds) -> None:
    """Share made worse and mean overlap over the share of results that are kept, as both thresholds move together."""
    figure = new_figure(9, 4.3, "the picture of the policy")
    axes = figure.subplots(1, 2)
    for c in cars:
        margin = (_logit(c.probabilities) - _logit(np.array(chosen))).min(axis=1)
        limits = [-np.inf, *np.sort(margin), np.inf]
        outcomes = [policy(c.observations, margin >= limit) for limit in limits]
        kept = [100 * p.kept for p in outcomes]
        (line,) = axes[0].plot(kept, [100 * p.worse for p in outcomes], label=f"{c.name} ({len(c.better)})")
        axes[1].plot(kept, [p.iou for p in outcomes], color=line.get_color())
        there = policy(c.observations, margin >= 0)
        axes[0].plot(100 * there.kept, 100 * there.worse, "o", color=line.get_color())
        axes[1].plot(100 * there.kept, there.iou, "o", color=line.get_color())
    axes[0].axhline(2, color="0.7", linewidth=1)
    axes[0].set(xlabel="results kept, %", ylabel="made worse by 0.05, % of all cars")
    axes[1].set(xlabel="results kept, %", ylabel="mean BEV IoU of what is returned")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=8)
    write_bytes(path, figure_png(figure))


def _logit(probability: Array) -> Array:
    clipped = np.clip(probability, 1e-6, 1 - 1e-6)
    return np.asarray(np.log(clipped / (1 - clipped)))
