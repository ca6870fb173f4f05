"""Cost of each term over the iterations."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from directshape_torch.io.figure_files import new_figure
from directshape_torch.visualize.inspection.car_view import CarView
from directshape_torch.visualize.inspection.panels import write_figure

_SIZE_INCHES = (8.5, 4.4)
# Of the largest total: terms below are not worth their decades of the axis.
_LEAST_SHARE = 1e-4


def costs_of_car(view: CarView) -> dict[str, NDArray[np.float64]]:
    """Cost (N + 1,) of each term by its name, at the final stage's settings, and their "sum"."""
    costs = view.trace.costs[:, view.car].cpu().numpy()
    named = dict(zip(view.trace.result.term_names, costs.T, strict=True))
    return {**named, "sum": costs.sum(axis=1)}


def stage_beginnings(stage: Sequence[int]) -> list[float]:
    """Places between the states where a later stage than the first begins.

    Examples:
        >>> stage_beginnings([-1, 0, 0, 1, 1])
        [2.5]
    """
    return [k - 0.5 for k in range(1, len(stage)) if stage[k] != stage[k - 1] and stage[k] > 0]


def write_cost_figure(path: Path | str, view: CarView) -> None:
    """Write the figure as PNG: all costs are those of the final stage, so a step of an earlier stage may raise them.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    figure = new_figure(*_SIZE_INCHES, "drawing costs")
    axes = figure.subplots()
    costs, iterations = costs_of_car(view), np.arange(len(view.trace))
    for name, values in costs.items():
        style = {"color": "black", "linewidth": 2.2} if name == "sum" else {"linewidth": 1.4}
        axes.plot(iterations, values, label=name, **style)
    accepted = view.trace.accepted[:, view.car].cpu().numpy()
    refused = ~accepted
    refused[0] = False
    axes.plot(
        iterations[refused], costs["sum"][refused], "x", color="0.5", markersize=5, label="step refused, or car done"
    )
    for number, place in enumerate(stage_beginnings(view.trace.stage)):
        axes.axvline(place, color="0.6", linestyle=":", label=None if number else "next stage")
    axes.set_yscale("log")
    axes.set_ylim(bottom=_LEAST_SHARE * costs["sum"].max())
    axes.set(xlabel="iteration", ylabel="cost at the final stage's settings", title=view.title)
    axes.xaxis.get_major_locator().set_params(integer=True)
    axes.grid(alpha=0.3)
    axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), fontsize=8)
    write_figure(path, figure)
