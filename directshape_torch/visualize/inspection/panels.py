"""Parts that several figures of the inspection share: image crops, lines, colours of the iterations, files."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from directshape_torch.visualize.drawing import Picture, Window
from directshape_torch.visualize.inspection.car_view import CarView, footprint_of_corners

Array = NDArray[np.float64]
Ink = Any  # whatever matplotlib takes for a colour

_BIRDS_EYE_MARGIN_M = 0.7


def iteration_inks(count: int) -> list[Ink]:
    """Colours from dark (the first) to bright (the last)."""
    from matplotlib import colormaps

    return [tuple(colour) for colour in colormaps["plasma"](np.linspace(0.0, 0.92, max(count, 1)))]


def show_crop(axes: Any, image: Picture, window: Window, title: str = "", *, dimmed: bool = False) -> None:
    """A window of an image whose axes are its pixels; grey and pale where something is to be drawn over it."""
    u0, v0, u1, v1 = window
    part = image[v0:v1, u0:u1]
    if dimmed:
        part = np.repeat(part.mean(axis=2, keepdims=True) * 0.55 + 20, 3, axis=2).astype(np.uint8)
    axes.imshow(part, extent=(u0 - 0.5, u1 - 0.5, v1 - 0.5, v0 - 0.5), interpolation="nearest")
    axes.set(xlim=(u0 - 0.5, u1 - 0.5), ylim=(v1 - 0.5, v0 - 0.5), xticks=[], yticks=[])
    axes.set_title(title, fontsize=9)


def draw_lines(axes: Any, lines: Iterable[Array], ink: Ink, label: str | None = None, **style: Any) -> None:
    """Lines (n, 2) as one entry of the legend."""
    for line in lines:
        axes.plot(line[:, 0], line[:, 1], color=ink, label=label, **style)
        label = None


def draw_footprint(axes: Any, corners: Array, ink: Ink, label: str | None = None, **style: Any) -> None:
    """A box seen from above, (4, 2) with the front first, and a stroke from its middle to its front."""
    closed = np.concatenate([corners, corners[:1]])
    axes.plot(closed[:, 0], closed[:, 1], color=ink, label=label, **style)
    stroke = np.stack([corners.mean(axis=0), corners[:2].mean(axis=0)])
    axes.plot(stroke[:, 0], stroke[:, 1], color=ink, **style)


def show_birds_eye(axes: Any, view: CarView, others: Iterable[Array]) -> None:
    """Ground around a car, with the true box where it is known; other footprints (4, 2) must fit in."""
    shown = [*view.footprints[[0, -1]], footprint_of_corners(view.detector_corners_cam), *others]
    if view.truth_corners_cam is not None:
        shown.append(footprint_of_corners(view.truth_corners_cam))
        draw_footprint(axes, shown[-1], "limegreen", "ground truth", linewidth=2.5)
    corners = np.concatenate(shown)
    middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
    half = np.ptp(corners, axis=0).max() / 2 + _BIRDS_EYE_MARGIN_M
    axes.set_aspect("equal")
    axes.set(xlim=middle[0] + np.array([-half, half]), ylim=middle[1] + np.array([-half, half]))
    axes.set(xlabel="x [m]", ylabel="z [m]")
    axes.grid(alpha=0.3)
