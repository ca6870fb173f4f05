"""Curves of a benchmark as pictures: one panel a quantity, both axes logarithmic and of one scale."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from directshape_torch.benchmark.rows import Curve
from directshape_torch.visualize.panel_row import write_panel_row

_PANEL_INCHES = 2.8


def write_plots(folder: Path | str, curves: Sequence[Curve]) -> list[Path]:
    """Write one picture for each label of a y axis, its panels side by side; returns the files.

    Args:
        folder: is made where it is missing.
        curves: at least one.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    paths = []
    for y_label in dict.fromkeys(curve.y_label for curve in curves):
        drawn = [curve for curve in curves if curve.y_label == y_label]
        panels = [[c for c in drawn if c.panel == name] for name in dict.fromkeys(c.panel for c in drawn)]
        path = Path(folder) / f"{y_label.partition(' [')[0].replace(' ', '_')}.png"
        write_panel_row(
            path, panels, _draw, f"{y_label.partition(' [')[0]} of one call", _PANEL_INCHES, "plotting a benchmark"
        )
        paths.append(path)
    return paths


def _draw(axes: Any, curves: Sequence[Curve]) -> None:
    for curve in curves:
        axes.loglog(curve.x, curve.y, marker="o", markersize=3, label=curve.name)
    x = sorted({value for curve in curves for value in curve.x})
    y = [value for curve in curves for value in curve.y]
    top = curves[0].y[-1] / curves[0].x[-1]
    y.append(top * x[0])
    axes.loglog([x[0], x[-1]], [top * x[0], top * x[-1]], linestyle="--", color="grey", label="proportional")
    axes.set(xlabel=curves[0].x_label, ylabel=curves[0].y_label, title=curves[0].panel)
    for axis, values in ((axes.xaxis, x), (axes.yaxis, _round_numbers(min(y), max(y)))):
        axis.set_ticks(values, [f"{value:g}" for value in values], fontsize=7)
        axis.set_ticks([], minor=True)
    # Both axes over as many decades, so that a slope looks like what it is.
    decades = max(x[-1] / x[0], max(y) / min(y)) ** 0.55
    for centre, limits in ((x[0] * x[-1], axes.set_xlim), (max(y) * min(y), axes.set_ylim)):
        limits(centre**0.5 / decades, centre**0.5 * decades)
    axes.set_box_aspect(1)
    axes.grid(alpha=0.3)


def _round_numbers(low: float, high: float) -> list[float]:
    """1, 2 and 5 times powers of ten around an interval."""
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
    return [digit * 10.0**power for power in range(first - 1, last + 1) for digit in (1, 2, 5)]
