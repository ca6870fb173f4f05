"""Pictures of tables: rows as figures with intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from directshape_torch.evaluation.bootstrap import Estimate
from directshape_torch.files.atomic_files import write_bytes
from directshape_torch.io.figure_files import figure_png, new_figure

_ROW_INCHES = 0.24


@dataclass(frozen=True)
class IntervalLine:
    """One row: its name, its figure, and whether it is the one that the others are compared with."""

    name: str
    estimate: Estimate
    is_reference: bool = False


def write_interval_plot(path: Path, lines: Sequence[IntervalLine], title: str, x_label: str) -> None:
    """Write the rows from top to bottom as PNG, with a vertical line at the reference; nothing for no rows.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    if not lines:
        return
    figure = new_figure(7.5, 1.0 + _ROW_INCHES * len(lines), "plotting tables")
    axes = figure.subplots()
    for place, line in enumerate(lines):
        value = line.estimate.value
        low, high = (value if end is None else end for end in (line.estimate.low, line.estimate.high))
        colour = "tab:red" if line.is_reference else "tab:blue"
        # A figure of very few cars may lie outside its own interval.
        ends = [[max(value - low, 0.0)], [max(high - value, 0.0)]]
        axes.errorbar([value], [place], xerr=ends, fmt="o", markersize=4, color=colour)
        if line.is_reference:
            axes.axvline(value, color=colour, linewidth=0.8, alpha=0.6)
    axes.set_yticks(range(len(lines)), [line.name for line in lines], fontsize=8)
    axes.set(title=title, xlabel=f"{x_label} (95 % intervals over cars)", ylim=(len(lines) - 0.5, -0.5))
    axes.grid(axis="x", alpha=0.3)
    write_bytes(path, figure_png(figure))
