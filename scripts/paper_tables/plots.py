"""Pictures of tables: rows as figures with intervals, and precision over recall of several methods."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from directshape_torch.errors import MissingDependencyError
from directshape_torch.evaluation.bootstrap import Estimate
from directshape_torch.io.atomic_files import write_bytes

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
    figure = _figure(7.5, 1.0 + _ROW_INCHES * len(lines))
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
    _write(path, figure)


def write_precision_plot(path: Path, panels: Mapping[str, Mapping[str, NDArray[np.float64]]], title: str) -> None:
    """Write precision at recall 0, 1/40 .. 1 as PNG: a panel for each title, a line for each method.

    All panels have the same methods; their names stand below, where they hide no curve.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    figure = _figure(3.6 * len(panels), 4.4)
    figure.suptitle(title)
    for axes, (name, curves) in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels.items(), strict=True):
        for method, precision in curves.items():
            axes.plot(np.linspace(0, 1, len(precision)), precision, label=method.replace("`", ""))
        axes.set(title=name, xlabel="recall", ylabel="precision", xlim=(0, 1), ylim=(0, 1.02))
        axes.grid(alpha=0.3)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=6)
    _write(path, figure)


def _figure(width_inches: float, height_inches: float) -> Any:
    try:
        # No pyplot: it keeps figures and picks a window system.
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingDependencyError("matplotlib", "plot", "plotting tables") from error
    figure = Figure(figsize=(width_inches, height_inches), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _write(path: Path, figure: Any) -> None:
    content = io.BytesIO()
    # Without the software's version, so that equal figures give equal bytes.
    figure.savefig(content, format="png", dpi=110, metadata={"Software": None})
    write_bytes(path, content.getvalue())
