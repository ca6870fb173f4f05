"""The V-shape: error of numeric differences over their step, one picture for each factor and term."""

from __future__ import annotations

from collections.abc import Sequence

from directshape_torch.io.figure_files import figure_png, new_figure
from directshape_torch.laboratory.comparison import BOUNDS, Comparison

_SMALLEST_SHOWN = 1e-16


def v_curves_png(name: str, comparisons: Sequence[Comparison]) -> bytes | None:
    """One line for each regime, error over the step: left plain central differences, right Richardson's.

    Medians; dotted the 99.9th percentile, which shows how soon large steps meet kinks.

    Returns:
        A PNG, or None where no regime has anything to draw.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    drawn = [(c.regime, c.curve) for c in comparisons if c.curve is not None]
    if not drawn:
        return None
    figure = new_figure(11, 4.6, "the plots of the laboratory")
    plain, extrapolated = figure.subplots(1, 2, sharey=True)
    for k, (regime, curve) in enumerate(drawn):
        style = {"color": f"C{k % 10}", "linestyle": "-" if k < 10 else "--", "marker": "o", "markersize": 3}
        plain.loglog(curve.steps, _shown(curve.central_median), label=regime, **style)
        plain.loglog(curve.steps, _shown(curve.central_999), color=f"C{k % 10}", linestyle=":", linewidth=0.7)
        extrapolated.loglog(curve.extrapolated_steps, _shown(curve.extrapolated_median), label=regime, **style)
    for axes, title in ((plain, "central differences"), (extrapolated, "with Richardson extrapolation")):
        axes.axhline(BOUNDS["analytic-numeric"], color="grey", linewidth=0.8)
        axes.set_title(title)
        axes.set_xlabel("step" if axes is plain else "smallest step of the stencil")
        axes.grid(alpha=0.3)
    plain.set_ylabel("error relative to the row's norm")
    extrapolated.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
    figure.suptitle(f"{name}: numeric differences against autograd (median; dotted: 99.9 %; grey: the bound)")
    return figure_png(figure)


def _shown(errors: Sequence[float]) -> list[float]:
    """Exact zeros have no place on a logarithmic axis: they are drawn at its lower end."""
    return [max(error, _SMALLEST_SHOWN) for error in errors]
