"""Figures of matplotlib as PNG files, drawn without a window system."""

from __future__ import annotations

import io
from typing import Any

from directshape_torch.errors import MissingDependencyError

_DOTS_PER_INCH = 110


def new_figure(width_inches: float, height_inches: float, purpose: str) -> Any:
    """An empty `matplotlib.figure.Figure` whose parts find their places by themselves.

    Args:
        width_inches, height_inches: of the whole picture.
        purpose: what is drawn, for the message when matplotlib is not installed.

    Raises:
        MissingDependencyError: matplotlib is not installed.

    Example:
        >>> figure = new_figure(4, 3, "an example")
        >>> line = figure.add_subplot().plot([0, 1], [1, 0])
        >>> figure_png(figure)[1:4]
        b'PNG'
    """
    try:
        # No pyplot: it keeps figures and picks a window system.
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingDependencyError("matplotlib", "plot", purpose) from error
    figure = Figure(figsize=(width_inches, height_inches), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def figure_png(figure: Any) -> bytes:
    """A figure of `new_figure` as PNG; equal figures give equal bytes."""
    content = io.BytesIO()
    # Without the software's version, which would make the bytes differ.
    figure.savefig(content, format="png", dpi=_DOTS_PER_INCH, metadata={"Software": None})
    return content.getvalue()
