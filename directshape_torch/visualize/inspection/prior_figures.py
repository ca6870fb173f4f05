"""A shape prior in figures: what its codes do, and known cars that it was fitted to (paper, supplement)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from directshape_torch.io.figure_files import new_figure
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.visualize.inspection.field_views import (
    FIELD_LIMIT_M,
    FRONT_VIEW,
    SURFACE_LIMIT_M,
    coloured_surface,
    distance_scale,
    draw_zero_level,
    show_section,
)
from directshape_torch.visualize.inspection.panels import TRUTH_INK, write_figure
from directshape_torch.visualize.inspection.prior_fit import FittedCar

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
