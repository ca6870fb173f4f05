"""A shape prior in figures: what its codes do, and known cars that it was fitted to (paper, supplement)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from directshape_torch.io.figure_files import figure_picture, new_figure, write_animation, write_figure
from directshape_torch.shape.prior_quality import FittedCar
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.visualize.drawing import Picture
from directshape_torch.visualize.inspection.panels import TRUTH_INK
from directshape_torch.visualize.inspection.shape_figure import (
    FIELD_LIMIT_M,
    FRONT_VIEW,
    REAR_VIEW,
    SURFACE_LIMIT_M,
    coloured_surface,
    distance_scale,
    draw_zero_level,
    show_section,
)

_FIT_LIMIT_M = 0.15
_NUM_SIGMA = 2.0
_CARS_A_ROW = 4


def write_code_figure(path: Path | str, prior: ShapePrior) -> None:
    """Write, as PNG, a row for each code at -2 and +2 standard deviations: surfaces, and fields in the middle plane.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    figure = new_figure(13.0, 1.4 * prior.num_codes + 0.4, "drawing a prior")
    figure.suptitle(f"{prior.num_codes} codes; surfaces coloured by their distance from the mean shape")
    axes = figure.subplots(prior.num_codes, 4, squeeze=False)
    mean = prior.values(prior.initial_code(1))[0].detach()
    for k, row in enumerate(axes):
        for column, sigma in enumerate((-_NUM_SIGMA, _NUM_SIGMA)):
            code = prior.initial_code(1)
            code[0, k] = sigma
            values = prior.values(code)[0].detach()
            row[column].imshow(coloured_surface(prior, values, mean, FRONT_VIEW, SURFACE_LIMIT_M))
            row[column].axis("off")
            row[column].set_title(f"code {k + 1}: {sigma:+.0f} sigma", fontsize=9)
            field = show_section(row[2 + column], prior, values, FIELD_LIMIT_M)
            draw_zero_level(row[2 + column], prior, mean, "0.4", linestyles="dotted")
    axes[0, 2].set_title("fields; dotted: the mean shape", fontsize=9)
    _add_scales(figure, axes, field, SURFACE_LIMIT_M, "outside of the mean shape [m]")
    write_figure(path, figure)


def write_fit_figure(path: Path | str, prior: ShapePrior, cars: Sequence[FittedCar]) -> None:
    """Write, as PNG, the fitted surfaces, coloured by their distance from the true ones, above their fields.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    rows = -(-len(cars) // _CARS_A_ROW)
    figure = new_figure(14.0, 2.9 * rows + 0.4, "drawing fitted cars")
    figure.suptitle("known cars (green) and the prior's nearest shapes (black)")
    axes = figure.subplots(2 * rows, _CARS_A_ROW, squeeze=False)
    for place in range(rows * _CARS_A_ROW):
        row, column = divmod(place, _CARS_A_ROW)
        surface, section = axes[2 * row, column], axes[2 * row + 1, column]
        surface.axis("off")
        if place >= len(cars):
            section.axis("off")
            continue
        car = cars[place]
        surface.imshow(coloured_surface(prior, car.values, car.truth, FRONT_VIEW, _FIT_LIMIT_M))
        surface.set_title(f"{car.name}: {car.error_cm:.1f} cm", fontsize=9)
        field = show_section(section, prior, car.values, FIELD_LIMIT_M)
        draw_zero_level(section, prior, car.truth, TRUTH_INK, linestyles="dashed")
    _add_scales(figure, axes, field, _FIT_LIMIT_M, "outside of the true car [m]")
    write_figure(path, figure)


def _add_scales(figure: Any, axes: Any, field: Any, limit_m: float, label: str) -> None:
    """Both scales to the right of all panels, as long as a few rows."""
    inches = figure.get_figheight()
    bars = {"location": "right", "extend": "both", "shrink": min(1.0, 4.0 / inches), "aspect": 25, "pad": 0.02}
    figure.colorbar(distance_scale(limit_m), ax=axes, label=f"surface: {label}", **bars)
    figure.colorbar(field, ax=axes, label="field: signed distance [m]", **bars)


_SIZE_INCHES = (9.0, 2.6)
_LARGEST, _STEPS_A_CODE, _SECONDS_A_STEP = 2.0, 12, 0.12


def code_path(num_codes: int, steps_a_code: int = _STEPS_A_CODE) -> Tensor:
    """Codes (K steps, K) that go to +2, to -2 and back to the mean shape, one code after the other.

    Examples:
        >>> code_path(2, steps_a_code=4).round().int().tolist()
        [[0, 0], [2, 0], [0, 0], [-2, 0], [0, 0], [0, 2], [0, 0], [0, -2]]
    """
    angle = 2 * math.pi * torch.arange(steps_a_code) / steps_a_code
    swing = _LARGEST * torch.sin(angle)
    blocks = [swing[:, None] * torch.eye(num_codes)[k] for k in range(num_codes)]
    return torch.cat(blocks)


def write_code_animation(path: Path | str, prior: ShapePrior) -> None:
    """Write the GIF: the surface from two sides, coloured by its distance from the mean shape, its field, the codes.

    Raises:
        MissingDependencyError: matplotlib or Pillow is not installed.
    """
    frames = code_frames(prior, code_path(prior.num_codes).to(prior.origin))
    write_animation(path, frames, [_SECONDS_A_STEP] * len(frames))


def code_frames(prior: ShapePrior, codes: Tensor) -> list[Picture]:
    """One picture (h, w, 3) for each of the codes (N, K)."""
    figure = new_figure(*_SIZE_INCHES, "drawing an animation")
    axes = figure.subplots(1, 4, width_ratios=[1, 1, 1, 0.7])
    mean = prior.values(prior.initial_code(1))[0].detach()
    _draw_codes(axes, prior, mean, mean, codes[0])
    # The parts find their places once: they would dance if every picture were laid out anew.
    figure_picture(figure)
    figure.set_layout_engine("none")
    frames = []
    for code in codes:
        for part in axes:
            part.clear()
        _draw_codes(axes, prior, prior.values(code[None])[0].detach(), mean, code)
        frames.append(figure_picture(figure))
    return frames


def _draw_codes(axes: Any, prior: ShapePrior, values: Tensor, mean: Tensor, code: Tensor) -> None:
    for part, direction in zip(axes[:2], (FRONT_VIEW, REAR_VIEW), strict=True):
        part.imshow(coloured_surface(prior, values, mean, direction, SURFACE_LIMIT_M))
        part.axis("off")
    show_section(axes[2], prior, values, FIELD_LIMIT_M)
    axes[3].bar(range(1, len(code) + 1), code.tolist(), color="royalblue")
    axes[3].set(ylim=(-2.2, 2.2), xticks=range(1, len(code) + 1), xlabel="code", yticks=[-2, 0, 2])
    axes[3].grid(alpha=0.3)
