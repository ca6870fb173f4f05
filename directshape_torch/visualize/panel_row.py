"""A row of panels with curves as one picture, the legend below the panels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from directshape_torch.errors import InputError
from directshape_torch.files import atomic_files
from directshape_torch.io.figure_files import figure_png, new_figure

Panel = TypeVar("Panel")

_TITLE_INCHES = 0.3
_LEGEND_LINE_INCHES = 0.25
# From the axes to a legend below its labels, in letters.
_PAD = 4
# Of a legend's entry: its piece of line with the gaps around, and a letter of its name.
_ENTRY_INCHES, _LETTER_INCHES = 0.6, 0.085


def write_panel_row(
    path: Path | str,
    panels: Sequence[Panel],
    draw: Callable[[Any, Panel], None],  # a panel's labelled lines onto its matplotlib axes
    title: str,
    panel_inches: float,
    purpose: str,
) -> None:
    """Write panels side by side as PNG, with one legend where all have lines of the same names, else one each.

    The curves may leave no corner of a panel free, so the legends stand below.

    Raises:
        InputError: there are no panels.
        MissingDependencyError: matplotlib is not installed.
    """
    if not panels:
        raise InputError("panels", "at least one", "none")
    width_inches = panel_inches * len(panels)
    figure = new_figure(width_inches, panel_inches + _TITLE_INCHES, purpose)
    figure.suptitle(title)
    row = figure.subplots(1, len(panels), squeeze=False)[0]
    for axes, panel in zip(row, panels, strict=True):
        draw(axes, panel)
    entries = [axes.get_legend_handles_labels() for axes in row]
    names = [labels for _, labels in entries]
    if all(labels == names[0] for labels in names):
        columns = _legend_columns(names[0], width_inches)
        figure.legend(*entries[0], loc="outside lower center", ncols=columns)
    else:
        columns = min(_legend_columns(labels, panel_inches) for labels in names)
        for axes, (handles, labels) in zip(row, entries, strict=True):
            axes.legend(handles, labels, loc="upper center", bbox_to_anchor=(0.5, 0), borderaxespad=_PAD, ncols=columns)
    lines = max(-(-len(labels) // columns) for labels in names)
    figure.set_figheight(panel_inches + _TITLE_INCHES + _LEGEND_LINE_INCHES * lines)
    atomic_files.write_bytes(path, figure_png(figure))


def _legend_columns(names: Sequence[str], width_inches: float) -> int:
    """How many entries of a legend stand side by side in that width."""
    entry_inches = _ENTRY_INCHES + _LETTER_INCHES * max(map(len, names), default=0)
    return max(1, min(len(names), int(width_inches / entry_inches)))
