"""A row of panels with curves as one picture, the legend below the panels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from directshape_torch.errors import InputError
from directshape_torch.io.figure_files import new_figure, write_figure

_PANEL_INCHES = 3.5
_TITLE_INCHES = 0.3
_LEGEND_LINE_INCHES = 0.25
# From the axes to a legend below its labels, in letters.
_PAD = 4
# Of a legend's entry: its piece of line with the gaps around, and a letter of its name.
_ENTRY_INCHES, _LETTER_INCHES = 0.6, 0.085


@dataclass(frozen=True)
class Curve:
    """One line of a panel.

    Attributes:
        name: for the legend.
        x, y: (T,); y is NaN where it has no value.
        low, high: (T,) ends of an interval about y, or None.
        dashed: a bound rather than a result.
    """

    name: str
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    low: NDArray[np.float64] | None = None
    high: NDArray[np.float64] | None = None
    dashed: bool = False


@dataclass(frozen=True)
class CurvePanel:
    """One panel: what its axes show, where they end (None: where the lines do) and its lines; both begin at 0."""

    x_label: str
    y_label: str
    curves: tuple[Curve, ...]
    title: str = ""
    x_max: float | None = None
    y_max: float | None = None


def write_curve_panels(path: Path | str, panels: Sequence[CurvePanel], title: str) -> None:
    """Write panels side by side as PNG, with one legend where all have lines of the same names, else one each.

    The curves may leave no corner of a panel free, so the legends stand below.

    Raises:
        InputError: there are no panels.
        MissingDependencyError: matplotlib is not installed.

    Examples:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "curves.png"
        >>> curve = Curve("easy", np.linspace(0, 1, 41), np.linspace(1, 0, 41))
        >>> write_curve_panels(path, [CurvePanel("recall", "precision", (curve,))], "Car")
        >>> path.read_bytes()[1:4]
        b'PNG'
    """
    if not panels:
        raise InputError("panels", "at least one", "none")
    width_inches = _PANEL_INCHES * len(panels)
    figure = new_figure(width_inches, _PANEL_INCHES + _TITLE_INCHES, "plotting curves")
    figure.suptitle(title)
    row = figure.subplots(1, len(panels), squeeze=False)[0]
    for axes, panel in zip(row, panels, strict=True):
        _draw(axes, panel)
    entries = [axes.get_legend_handles_labels() for axes in row]
    names = [labels for _, labels in entries]
    if all(labels == names[0] for labels in names):
        columns = _legend_columns(names[0], width_inches)
        figure.legend(*entries[0], loc="outside lower center", ncols=columns)
    else:
        columns = min(_legend_columns(labels, _PANEL_INCHES) for labels in names)
        for axes, (handles, labels) in zip(row, entries, strict=True):
            axes.legend(handles, labels, loc="upper center", bbox_to_anchor=(0.5, 0), borderaxespad=_PAD, ncols=columns)
    lines = max(-(-len(labels) // columns) for labels in names)
    figure.set_figheight(_PANEL_INCHES + _TITLE_INCHES + _LEGEND_LINE_INCHES * lines)
    write_figure(path, figure)


def _draw(axes: Any, panel: CurvePanel) -> None:
    for curve in panel.curves:
        style = {"linestyle": "--", "color": "grey"} if curve.dashed else {}
        (line,) = axes.plot(curve.x, curve.y, label=curve.name, **style)
        if curve.low is not None and curve.high is not None:
            axes.fill_between(curve.x, curve.low, curve.high, color=line.get_color(), alpha=0.2, linewidth=0)
    axes.set(title=panel.title, xlabel=panel.x_label, ylabel=panel.y_label)
    axes.set_xlim(0, panel.x_max)
    axes.set_ylim(0, panel.y_max)
    axes.grid(alpha=0.3)


def _legend_columns(names: Sequence[str], width_inches: float) -> int:
    """How many entries of a legend stand side by side in that width."""
    entry_inches = _ENTRY_INCHES + _LETTER_INCHES * max(map(len, names), default=0)
    return max(1, min(len(names), int(width_inches / entry_inches)))
