"""Figures of matplotlib as PNG files and animations, drawn without a window system."""

from __future__ import annotations

import importlib
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from directshape_torch.errors import InputError, MissingDependencyError
from directshape_torch.files import atomic_files

_DOTS_PER_INCH, _ANIMATION_DOTS_PER_INCH = 110, 80
_GIF_COLOURS = 255


def check_figures(purpose: str) -> None:
    """Raise `MissingDependencyError` before the work is done whose pictures, of that purpose, could not be drawn."""
    try:
        importlib.import_module("matplotlib.figure")
    except ImportError as error:
        raise MissingDependencyError("matplotlib", "plot", purpose) from error


def new_figure(width_inches: float, height_inches: float, purpose: str) -> Any:
    """An empty `matplotlib.figure.Figure` whose parts find their places by themselves.

    Args:
        width_inches, height_inches: of the whole picture.
        purpose: what is drawn, for the message when matplotlib is not installed.

    Raises:
        MissingDependencyError: matplotlib is not installed.

    Examples:
        >>> figure = new_figure(4, 3, "an example")
        >>> line = figure.add_subplot().plot([0, 1], [1, 0])
        >>> figure_png(figure)[1:4]
        b'PNG'
    """
    check_figures(purpose)
    # No pyplot: it keeps figures and picks a window system.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_inches, height_inches), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def figure_png(figure: Any) -> bytes:
    """A figure of `new_figure` as PNG; equal figures give equal bytes."""
    # Where panels keep an aspect, labels may reach out of the picture until the parts have found their places twice.
    figure.draw_without_rendering()
    content = io.BytesIO()
    # Without the software's version, which would make the bytes differ.
    figure.savefig(content, format="png", dpi=_DOTS_PER_INCH, metadata={"Software": None})
    return content.getvalue()


def write_figure(path: Path | str, figure: Any) -> None:
    """Write a figure of `new_figure` as PNG."""
    atomic_files.write_bytes(path, figure_png(figure))


def figure_picture(figure: Any) -> NDArray[np.uint8]:
    """A figure of `new_figure` as pixels (h, w, 3), RGB, for animations.

    Examples:
        >>> figure_picture(new_figure(2, 1, "an example")).shape
        (80, 160, 3)
    """
    figure.set_dpi(_ANIMATION_DOTS_PER_INCH)
    figure.canvas.draw()
    return np.array(figure.canvas.buffer_rgba(), dtype=np.uint8)[..., :3]


def write_animation(path: Path | str, frames: Sequence[NDArray[np.uint8]], seconds: Sequence[float]) -> None:
    """Write an animated GIF that repeats for ever.

    Args:
        path: of the file.
        frames: (h, w, 3) pictures of one size, RGB.
        seconds: how long each is shown; GIF counts in hundredths.

    Raises:
        InputError: no frames, frames of several sizes, or not one duration each.
        MissingDependencyError: Pillow is not installed.

    Examples:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "blink.gif"
        >>> write_animation(path, [np.full((8, 8, 3), level, np.uint8) for level in (0, 255)], [0.5, 0.5])
        >>> path.read_bytes()[:6]
        b'GIF89a'
    """
    if not frames or len({frame.shape for frame in frames}) != 1:
        shapes = ", ".join(str(frame.shape) for frame in frames) or "none"
        raise InputError("frames", "at least one picture, all of one size", shapes)
    if len(seconds) != len(frames):
        raise InputError("seconds", f"one for each of {len(frames)} frames", f"{len(seconds)}")
    try:
        from PIL import Image
    except ImportError as error:
        raise MissingDependencyError("pillow", "plot", "writing an animation") from error
    # One palette for all frames, or colours that stay would flicker.
    together = Image.fromarray(np.concatenate([*frames]))
    palette = together.quantize(_GIF_COLOURS, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    pictures = [Image.fromarray(f).quantize(palette=palette, dither=Image.Dither.NONE) for f in frames]
    content = io.BytesIO()
    durations = [round(1000 * s) for s in seconds]
    pictures[0].save(
        content, format="GIF", save_all=True, append_images=pictures[1:], duration=durations, loop=0, optimize=False
    )
    atomic_files.write_bytes(path, content.getvalue())
