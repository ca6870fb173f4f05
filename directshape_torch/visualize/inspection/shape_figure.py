"""The shape before and after a refinement, coloured by signed distance."""

from __future__ import annotations

from pathlib import Path

from directshape_torch.io.figure_files import new_figure
from directshape_torch.visualize.inspection.car_view import CarView
from directshape_torch.visualize.inspection.field_views import (
    FIELD_LIMIT_M,
    FRONT_VIEW,
    REAR_VIEW,
    SURFACE_LIMIT_M,
    coloured_surface,
    distance_scale,
    show_section,
)
from directshape_torch.visualize.inspection.panels import write_figure

_SIZE_INCHES = (11.0, 3.9)


def write_shape_figure(path: Path | str, view: CarView) -> None:
    """Write the figure as PNG: surfaces coloured by their distance to the input's shape, and fields in the middle.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    figure = new_figure(*_SIZE_INCHES, "drawing shapes")
    figure.suptitle(view.title)
    axes = figure.subplots(2, 3)
    prior = view.prior
    before, after = (prior.values(view.state(k).code)[0] for k in (0, len(view.trace) - 1))
    for row, (name, values) in enumerate((("before", before), ("after", after))):
        for column, direction in enumerate((FRONT_VIEW, REAR_VIEW)):
            axes[row, column].imshow(coloured_surface(prior, values, before, direction, SURFACE_LIMIT_M))
            axes[row, column].axis("off")
        field = show_section(axes[row, 2], prior, values, FIELD_LIMIT_M, f"{name}: field in the middle plane")
    axes[0, 0].set_title("before", fontsize=9)
    axes[1, 0].set_title("after, coloured by its distance from the surface before", fontsize=9, loc="left")
    bars = {"shrink": 0.8, "extend": "both"}
    figure.colorbar(distance_scale(SURFACE_LIMIT_M), ax=axes[:, :2], label="outside of the surface before [m]", **bars)
    figure.colorbar(field, ax=axes[:, 2], label="signed distance [m]", **bars)
    write_figure(path, figure)
