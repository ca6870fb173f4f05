"""Shape errors over the distance tau as a picture: a panel for each metric, a line and its interval each method."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from directshape_torch.errors import InputError, MissingDependencyError
from directshape_torch.io import atomic_files

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

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "curves.png"
        >>> curve = TauCurve("after", np.array([0.1, 0.2]), np.array([0.5, 0.9]))
        >>> write_tau_plot(path, [TauPanel("completeness", 1.0, (curve,))], "cars")
        >>> path.read_bytes()[1:4]
        b'PNG'
    """
    if not panels:
        raise InputError("panels", "at least one", "none")
    try:
        # No pyplot: it keeps figures and picks a window system.
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingDependencyError("matplotlib", "plot", "plotting shape errors") from error
    figure = Figure(figsize=(_PANEL_INCHES * len(panels), _PANEL_INCHES + 0.6), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title)
    for axes, panel in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        _draw(axes, panel)
    handles, names = axes.get_legend_handles_labels()
    # Below the panels: the curves leave no corner of a panel free in all cases.
    figure.legend(handles, names, loc="outside lower center", ncols=max(1, len(names)))
    content = io.BytesIO()
    # Without the software's version, so that equal curves give equal bytes.
    figure.savefig(content, format="png", dpi=110, metadata={"Software": None})
    atomic_files.write_bytes(path, content.getvalue())


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
