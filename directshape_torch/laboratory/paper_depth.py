"""How wrong is the paper's depth derivative on real shapes?

The paper (supplement, `d d / d Phi = -1 / cos(theta)`) takes the gradient of the field for a unit vector and the depth
along the ray for the depth along the optical axis. Exact is `-1 / (grad . ray)` with the ray of unit depth, so the
paper's rows are longer by the factor `|grad| |ray|`: two independent errors, measured together and one by one.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from directshape_torch.energy.photometric_term import PhotometricTerm
from directshape_torch.energy.term import TermLinearisation
from directshape_torch.laboratory.bench import Bench
from directshape_torch.laboratory.comparison import quantile
from directshape_torch.laboratory.steps import gauss_newton_step, largest, median, step_shift
from directshape_torch.residuals.photometric import DSO_PATTERN

PAPER = "paper: both"
UNIT_GRADIENT = "unit gradient only"
DEPTH_ALONG_RAY = "depth along the ray only"


def row_factors(gradient: Tensor, ray: Tensor) -> dict[str, Tensor]:
    """By what each approximation multiplies the exact rows (Q,), from gradients (Q, 3) and rays of unit depth (Q, 3).

    Example:
        >>> row_factors(torch.tensor([[0.0, 0.0, 0.8]]), torch.tensor([[0.0, 0.75, 1.0]]))[PAPER]
        tensor([1.])
    """
    return {
        PAPER: gradient.norm(dim=-1) * ray.norm(dim=-1),
        UNIT_GRADIENT: gradient.norm(dim=-1),
        DEPTH_ALONG_RAY: ray.norm(dim=-1),
    }


@dataclass(frozen=True)
class PaperDepthError:
    """The photometric term with an approximate depth derivative against the exact one, in one regime.

    Attributes:
        variant: which part of the approximation.
        regime: of the states.
        rays: photometric pixels.
        factor_median: of the approximate over the exact derivative.
        row_error_median, row_error_95, row_error_max: of the rows, relative.
        gradient_error_median: over the cars, of the term's gradient, relative.
        turned_deg_median, turned_deg: angle between the solver's first steps, in the trust region's metric.
        step_share: largest difference of those steps as a share of the trust region.
        step_m_median, step_m, step_deg_median, step_deg: the same in metres and degrees.
    """

    variant: str
    regime: str
    rays: int
    factor_median: float
    row_error_median: float
    row_error_95: float
    row_error_max: float
    gradient_error_median: float
    turned_deg_median: float
    turned_deg: float
    step_share: float
    step_m_median: float
    step_m: float
    step_deg_median: float
    step_deg: float


@torch.no_grad()
def paper_depth_errors(bench: Bench) -> list[PaperDepthError]:
    """All variants at the states of a bench; nothing where no photometric pixel is usable."""
    term = bench.terms["photometric"]
    assert isinstance(term, PhotometricTerm)
    assert term.fixed is not None
    rays, root = bench.projected.left.surface(term.fixed.pixel_index)
    usable = term.residuals(bench.projected).usable[:: len(DSO_PATTERN)]
    if not bool(usable.any()):
        return []
    gradient = bench.projected.shape.value_and_derivatives(rays.at(root.depth), rays.object_index).gradient
    factors = row_factors(gradient, rays.direction_obj)
    return [_error(bench, term, variant, factor, usable) for variant, factor in factors.items()]


def _error(bench: Bench, term: PhotometricTerm, variant: str, factor: Tensor, usable: Tensor) -> PaperDepthError:
    parts = {t.name: t.linearise(bench.projected) for t in bench.problem.terms}
    approximate = scaled_linearisation(bench, term, factor)
    exact = parts["photometric"].gradient
    seen = exact.norm(dim=1) > 0
    gradient_error = ((approximate.gradient - exact).norm(dim=1) / exact.norm(dim=1))[seen]
    steps = [gauss_newton_step(bench.problem, list((parts | p).values())) for p in ({}, {"photometric": approximate})]
    shift = step_shift(bench.problem, *steps)
    row_error = (factor - 1).abs()[usable]
    return PaperDepthError(
        variant, bench.regime.name, int(usable.sum()), median(factor[usable]), median(row_error),
        quantile(row_error, 0.95), largest(row_error), median(gradient_error),
        median(shift.turned_deg[seen]), largest(shift.turned_deg[seen]), largest(shift.trust_region_share),
        median(shift.metres[seen]), largest(shift.metres), median(shift.degrees[seen]), largest(shift.degrees),
    )  # fmt: skip


def scaled_linearisation(bench: Bench, term: PhotometricTerm, factor: Tensor) -> TermLinearisation:
    """The term's linearisation with the depth derivative of each pixel (Q,) multiplied by a factor."""
    rows = term.residuals(bench.projected)
    J = term.jacobian(bench.projected) * factor.repeat_interleave(len(DSO_PATTERN))[:, None]
    return term.accumulate(rows, J)
