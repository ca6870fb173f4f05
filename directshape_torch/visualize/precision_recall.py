"""Precision over recall as a picture: a panel for each metric and overlap, a line for each difficulty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from directshape_torch.visualize.panel_row import write_panel_row

_PANEL_INCHES = 3.6


@dataclass(frozen=True)
class RecallCurve:
    """One line of a panel.

    Attributes:
        name: for the legend.
        values: (41,) precision or orientation similarity at recall 0, 1/40 .. 1, shares.
    """

    name: str
    values: NDArray[np.float64]


@dataclass(frozen=True)
class RecallPanel:
    """One panel: its title, what its y axis shows, and its lines."""

    title: str
    y_label: str
    curves: tuple[RecallCurve, ...]


def write_recall_plot(path: Path | str, panels: Sequence[RecallPanel], title: str) -> None:
    """Write the panels side by side as PNG.

    Raises:
        InputError: there are no panels.
        MissingDependencyError: matplotlib is not installed.

    Examples:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "curves.png"
        >>> panel = RecallPanel("3D, IoU > 0.7", "precision", (RecallCurve("easy", np.linspace(1, 0, 41)),))
        >>> write_recall_plot(path, [panel], "Car")
        >>> path.read_bytes()[1:4]
        b'PNG'
    """
    write_panel_row(path, panels, _draw, title, _PANEL_INCHES, "plotting precision over recall")


def _draw(axes: Any, panel: RecallPanel) -> None:
    for curve in panel.curves:
        axes.plot(np.linspace(0, 1, len(curve.values)), curve.values, label=curve.name)
    axes.set(title=panel.title, xlabel="recall", ylabel=panel.y_label, xlim=(0, 1), ylim=(0, 1.02))
    axes.grid(alpha=0.3)
