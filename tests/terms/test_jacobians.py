"""Every term against the reference, by value and by gradient, and its hand-derived Jacobian against autograd."""

from __future__ import annotations

import math

import pytest
import torch
from helpers.derivatives import moved, tangent_of
from helpers.term_cases import ALL_CONFIGS, REGIMES, case
from reference import residuals as reference
from torch import Tensor

from directshape_torch.refinement.problem import CarStage
from directshape_torch.terms.cars import CarState
from directshape_torch.terms.photometric import Photometric, Surface
from directshape_torch.terms.photometric_rows import CONTRAST_FLOOR, DSO_PATTERN, patch_residual
from directshape_torch.terms.point_cloud import PointCloud
from directshape_torch.terms.priors import PriorTerm
from directshape_torch.terms.silhouette import SilhouetteProducts, Silhouettes
from directshape_torch.terms.term import Linear, Term

CASES = [("typical", config) for config in ALL_CONFIGS] + [(regime, "default") for regime in REGIMES[1:]]
CASES += [(regime, "normalised") for regime in ("near", "far")]


def _rows(begun: CarStage, state: CarState) -> list[tuple[Term, Linear]]:
    sight = begun.problem.look(state)
    return [(term, term.linear(sight.field, state, term.where(sight))) for term in begun.terms]


def _jacobian(at: Linear) -> Tensor:
    return at.J_residual_inner[..., None] * at.J_inner_state[:, :, None]


def _reference(begun: CarStage, term: Term, at: Linear, state: CarState) -> Tensor:
    """Residuals (M, R, N) of the reference; photometric ones NaN where no surface is met."""
    prior = begun.problem.prior
    if isinstance(term, SilhouetteProducts):
        return reference.product(prior, term, state, at.where[0], at.where[1])[..., None]
    if isinstance(term, Silhouettes):
        return reference.silhouette(prior, term, state)[..., None]
    if isinstance(term, PointCloud):
        return reference.point_cloud(prior, term, state)[..., None]
    assert isinstance(term, Photometric)
    depth, found = reference.surface_depth(prior, term, state)
    rows, config = term.pixel_set.rows, term.config
    plain, _, _ = reference.photometric(term, begun.config.image_level, torch.where(found, depth, torch.nan))
    left = rows.intensity_left.movedim(0, -1)
    # The term's own left levels hold the match of brightness, which `test_brightness` examines.
    given = _left_levels(begun, term)
    of_patch = left, rows.neighbour_weight.movedim(0, -1), config.patch, CONTRAST_FLOOR
    return patch_residual(plain + given - left, *of_patch)


def _left_levels(begun: CarStage, term: Photometric) -> Tensor:
    """Left grey levels (M, R, 8) before any match of brightness."""
    images, fixed = term.left.pyramid[begun.config.image_level], term.pixel_set
    own = term.left.packed.row.flatten()[fixed.sight_place]
    uv = (term.left.pixels.uv[own][:, :, None] + 0.5) * images.scale - 0.5 + torch.tensor(DSO_PATTERN)
    frame = term.cars.frame_index[fixed.blocks.owner].tolist()
    sizes = [images.sizes[f].tolist() for f in frame]
    return torch.stack(
        [
            reference.bilinear(images.left[f, :h, :w], *x.unbind(-1))
            for f, (h, w), x in zip(frame, sizes, uv, strict=True)
        ]
    )


@pytest.mark.parametrize(("regime", "config"), CASES)
def test_values_and_gradients_are_those_of_the_reference(regime: str, config: str) -> None:
    """The reference looks for every minimum and every surface anew at every displaced state, in three directions."""
    begun, state = case(regime, config)
    step = 1e-6
    directions = torch.randn(3, tangent_of(state).shape[1], generator=torch.Generator().manual_seed(2)).double()
    for term, at in _rows(begun, state):
        if isinstance(term, PriorTerm):
            continue
        counts = (term.row_weight.expand_as(at.residual) > 0) & (at.J_residual_inner != 0)
        expected = _reference(begun, term, at, state)
        near = torch.isclose(at.residual, expected, rtol=1e-8, atol=1e-7)
        # A ray with two minima of nearly the same distance may be given the other one: its nearest sample tells.
        assert near[counts].double().mean() > 0.98, (
            term.names,
            (at.residual - expected)[counts].abs().sort().values[-20:],
        )
        J, slopes = _jacobian(at), []
        for direction in directions:
            delta = (step * direction).expand_as(tangent_of(state))
            ends = [_reference(begun, term, at, moved(state, sign * delta)) for sign in (1, -1)]
            slopes.append((ends[0] - ends[1]) / (2 * step))
        error = (torch.stack(slopes, dim=-1) - J @ directions.mT).norm(dim=-1)[counts] / J.norm(dim=-1)[counts].max()
        # Looking up images and grids has kinks at the borders of pixels and cells, which a difference may straddle.
        assert error.median() < 1e-7, term.names
        assert (error < 1e-4).double().mean() > 0.98, (term.names, error.topk(5).values)


def test_a_row_without_a_slope_has_no_jacobian() -> None:
    """What `counts` leaves out above: rays that are certain, and pixels that were lost, change nothing."""
    begun, state = case()
    for term, at in _rows(begun, state):
        if isinstance(term, Photometric):
            where = at.where
            assert isinstance(where, Surface)
            assert (at.J_residual_inner[~where.usable] == 0).all()
            assert (at.residual[~where.usable] == term.config.lost_grey_levels).all()
        assert math.isfinite(float(at.residual.abs().max()))
