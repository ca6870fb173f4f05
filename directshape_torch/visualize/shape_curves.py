"""Shape errors over the distance tau as a picture: a panel for each metric, a line and its interval each method."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from directshape_torch.visualize.panel_row import write_panel_row

_PANEL_INCHES = 3.4


@dataclass(frozen=True)
class TauCurve:
    """One line of a panel, NaN where it has no value.

    Attributes:
        name: for the legend.
        taus_m: (T,) metres.
        values: (T,).
        low, high: (T,) ends of the interval, or None.
        dashed: a bound rather than a result.
    """

    name: str
    taus_m: NDArray[np.float64]
    values: NDArray[np.float64]
    low: NDArray[np.float64] | None = None
    high: NDArray[np.float64] | None = None
    dashed: bool = False


@dataclass(frozen=True)
class TauPanel:
    """One panel: what its y axis shows, where that ends (None: where the lines do), and its lines.

    All panels of a picture have lines of the same names.
    """

    y_label: str
    y_max: float | None
    curves: tuple[TauCurve, ...]


def write_tau_plot(path: Path | str, panels: Sequence[TauPanel], title: str) -> None:
    """Write the panels side by side as PNG.

    Raises:
        InputError: there are no panels.
        MissingDependencyError: matplotlib is not installed.

    Examples:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "curves.png"
        >>> curve = TauCurve("after", np.array([0.1, 0.2]), np.array([0.5, 0.9]))
        >>> write_tau_plot(path, [TauPanel("completeness", 1.0, (curve,))], "cars")
        >>> path.read_bytes()[1:4]
        b'PNG'
    """
    write_panel_row(path, panels, _draw, title, _PANEL_INCHES, "plotting shape errors")


def _draw(axes: Any, panel: TauPanel) -> None:
    for curve in panel.curves:
        style = {"linestyle": "--", "color": "grey"} if curve.dashed else {}
        (line,) = axes.plot(curve.taus_m, curve.values, label=curve.name, **style)
        if curve.low is not None and curve.high is not None:
            axes.fill_between(curve.taus_m, curve.low, curve.high, color=line.get_color(), alpha=0.2, linewidth=0)
    axes.set(xlabel="tau [m]", ylabel=panel.y_label)
    axes.set_xlim(left=0)
    axes.set_ylim(0, panel.y_max)
    axes.grid(alpha=0.3)
