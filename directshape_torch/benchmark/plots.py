"""Curves of a benchmark as pictures: one panel a quantity, both axes logarithmic."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from directshape_torch.benchmark.rows import Curve
from directshape_torch.visualize.panel_row import write_panel_row

_PANEL_INCHES = 3.4


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
        write_panel_row(path, panels, _draw, f"{y_label} of one call", _PANEL_INCHES, "plotting a benchmark")
        paths.append(path)
    return paths


def _draw(axes: Any, curves: Sequence[Curve]) -> None:
    for curve in curves:
        axes.loglog(curve.x, curve.y, marker="o", markersize=3, label=curve.name)
    axes.set(xlabel=curves[0].x_label, ylabel=curves[0].y_label, title=curves[0].panel)
    ticks = sorted({x for curve in curves for x in curve.x})
    axes.set_xticks(ticks, [f"{x:g}" for x in ticks], fontsize=7)
    axes.minorticks_off()
    axes.grid(alpha=0.3)
