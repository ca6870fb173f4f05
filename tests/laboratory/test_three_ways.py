"""The bounds hold on a small draw for every term; `mutate_jacobians.py` shows that wrong terms break them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch

from directshape_torch.laboratory.bench import TERM_NAMES, TRACK_NAMES, Bench
from directshape_torch.laboratory.comparison import compare
from directshape_torch.laboratory.experiments import AT_FIXED_DEPTHS, gradient_experiment, jacobian, term_experiment
from directshape_torch.laboratory.regimes import REGIMES
from directshape_torch.shape.field import field_of
from directshape_torch.terms import photometric
from directshape_torch.terms.depth import Closest
from directshape_torch.terms.term import linear_of

BenchOf = Callable[..., Bench]
_MORE = {"disparity_offset": ("rig",), "track": TRACK_NAMES}
_EMPTY = "grid_border", "photometric"
_SHORT = ("typical", "near_3m", "grazing", "identity_rotation", "grid_border", "disparity_offset", "track")
_ALL = [pytest.param(name, marks=[] if name in _SHORT else pytest.mark.long) for name in REGIMES]


def _long(*regimes: str) -> list[Any]:
    return [pytest.param(name, marks=pytest.mark.long) for name in regimes]


def _differenced(regime: str) -> tuple[str, ...]:
    """The terms to compare numerically; for the expensive state of a track only those that exist nowhere else."""
    return TRACK_NAMES if regime == "track" else (*TERM_NAMES, *_MORE.get(regime, ()))


@pytest.mark.parametrize("regime", _ALL)
def test_linear_is_the_derivative_of_residual_in_every_regime(bench_of: BenchOf, regime: str) -> None:
    """Hand-derived against autograd to 1e-9, and both ways to compute a residual give the same value."""
    bench = bench_of(regime)
    subjects = term_experiment(bench, list(bench.terms)).subjects
    assert [subject.name for subject in subjects] == [*TERM_NAMES, *_MORE.get(regime, ())]
    for subject in subjects:
        norm = subject.norm
        assert len(norm) > 0 or (regime, subject.name) == _EMPTY
        if len(norm):
            scale = norm.clamp_min(1e-6 * float(norm.max()))[:, None]
            assert float(((subject.analytic - subject.autograd).abs() / scale).max()) < 1e-9, subject.name
            assert float(norm.max()) > 0
        assert subject.value_error < 1e-12


@pytest.mark.parametrize("regime", ["grid_border", "track", *_long("typical", "contour")])
def test_terms_against_differences(bench_of: BenchOf, regime: str) -> None:
    """Differences look anew at each displaced state: the cost that is compared has the gradient that is followed."""
    for found in compare(term_experiment(bench_of(regime), _differenced(regime)), regime):
        assert found.broken_bounds() == []
        assert found.compared > 0 or (regime, found.name) == _EMPTY


def test_a_bench_finds_minima_inside_cells_and_on_their_faces_and_borders(bench_of: BenchOf) -> None:
    """All kinds of closest points are among those that are differenced above."""
    bench = bench_of("grid_border")
    face = bench.rows["silhouettes"].anchor.face_obj.abs().sum(0)  # type: ignore[attr-defined]
    assert bool((face == 0).any())
    assert bool((face == 1).any())


@pytest.mark.parametrize("regime", ["grid_border", *_long("typical")])
def test_rays_are_closest_where_they_are_said_to_be(bench_of: BenchOf, regime: str) -> None:
    """Marched, and tracked after a step of millimetres: nothing within 4 mm along the ray is nearer to the car."""
    bench = bench_of(regime)
    masks, term = bench.problem.masks, bench.terms["silhouettes"]
    moved = bench.moved(torch.full((bench.num_unknowns,), 1e-3, dtype=torch.float64))
    field = field_of(bench.problem.prior.bind(moved.code))
    tracked = term.linear(field, moved, bench.prepared.closest).anchor
    assert isinstance(tracked, Closest)
    offset = torch.linspace(-0.004, 0.004, 161, dtype=torch.float64)[:, None, None]
    # The border is left out, by a tenth of a millimetre.
    lower, upper = (x.view(3, 1, 1, 1) for x in bench.problem.prior.bounds_obj)
    for at, state, closest in ((bench.prepared.field, bench.state, bench.prepared.closest), (field, moved, tracked)):
        points = masks.rays.in_objects(state.T_obj_cam).at(closest.depth + offset)
        inside = ((points >= lower + 1e-4) & (points <= upper - 1e-4)).all(0)
        sdf = at.sdf(points, masks.rays.owner)
        nearest = torch.where(inside, sdf, torch.inf).amin(0)
        seen = closest.crosses & (masks.filled > 0)
        assert bool((sdf[80] <= nearest + 1e-9)[seen].all())
        smooth = seen & (closest.face_obj == 0).all(0) & inside.all(0)
        found = ((sdf[79] - 2 * sdf[80] + sdf[81]) / 5e-5**2)[smooth]
        rays = masks.rays.in_objects(state.T_obj_cam)
        curvature = at.curvature_along(masks.rays.owner, *rays, closest.depth)[smooth]
        apart = (found - curvature).abs() / found.abs().clamp_min(0.1)
        assert float(apart.median()) < 1e-3
        assert int(smooth.sum()) > (5 if regime == "typical" else 0)


@pytest.mark.parametrize("regime", ["typical", *_long("far_80m")])
def test_sums_are_those_of_single_residuals(bench_of: BenchOf, regime: str) -> None:
    """Cost, gradient and both matrices of every column, and of what the solver sees, one residual after the other."""
    bench = bench_of(regime)
    num_cars, size = len(bench.state.code), bench.num_unknowns
    factors = torch.linspace(0.5, 2.0, num_cars * len(bench.problem.term_names)).double().view(num_cars, -1)
    problem = replace(bench.problem, factors=factors)
    stage = replace(bench.stage, problem=problem)
    figures = stage.figures(bench.prepared)
    column = 0
    for number_of_term, term in enumerate(stage.terms):
        at = linear_of(term, bench.problem.prior, bench.prepared.field, bench.state, term.anchor(bench.prepared))
        norm, J = term.norm(at.residual), jacobian(at)
        assert torch.equal(figures.parts[number_of_term].residual, at.residual)
        for number in range(len(term.names)):
            for car in range(num_cars):
                of_cell = (term.blocks.owner == car) & (term.column == number)
                factor = factors[car, column]
                weight = factor * (term.block_weight[:, None, None] * term.row_weight)[of_cell]
                seen = factor * (term.information[:, None, None] * term.row_weight)[of_cell]
                flat = J[of_cell].reshape(-1, size)
                expected = (
                    (weight * norm.rho[of_cell]).sum(),
                    (weight * norm.gradient_weight[of_cell]).flatten() @ flat,
                    flat.mT @ ((weight * norm.hessian_weight[of_cell]).flatten()[:, None] * flat),
                    flat.mT @ ((seen * norm.information_weight[of_cell]).flatten()[:, None] * flat),
                )
                for found, by_hand in zip(figures[:4], expected, strict=True):
                    torch.testing.assert_close(found[car, column], by_hand, rtol=1e-11, atol=1e-12)
            column += 1
    iterations, start = stage.start(bench.prepared)
    again = iterations.evaluated(bench.prepared.field, bench.state, start.anchors)
    solver = replace(problem.config.solver, jacobian="autograd")
    witness = replace(stage, problem=replace(problem, config=replace(problem.config, solver=solver)))
    by_autograd = witness.start(bench.prepared)[1]
    for seen_by_solver in (start, again, by_autograd):
        torch.testing.assert_close(seen_by_solver.cost, figures.cost, rtol=1e-6, atol=0)
        # Rays that rest are left out of gradient and matrix: they are certain.
        torch.testing.assert_close(seen_by_solver.gradient, figures.gradient.sum(dim=1), rtol=1e-3, atol=1e-3)
        torch.testing.assert_close(seen_by_solver.hessian, figures.hessian.sum(dim=1), rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(by_autograd.gradient, start.gradient, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(by_autograd.hessian, start.hessian, rtol=1e-9, atol=1e-9)


@torch.no_grad()
def test_a_tracked_pixel_ends_on_the_surface(bench_of: BenchOf) -> None:
    """After a step of the car the depth is a Newton step nearer to the surface than the point it is taken from."""
    bench = bench_of("typical", pixels=40)
    term, field = bench.stage.photometric, bench.prepared.field
    assert term is not None
    step = torch.full((len(bench.state.code), bench.num_unknowns), 0.03, dtype=torch.float64)
    moved = bench.state.unknowns.retract(bench.state, step, max_code=3.0)._replace(code=bench.state.code)
    rays = term.pixel_set.rows.rays
    found = photometric.near_surface(rays, field, moved, term.anchor(bench.prepared))
    here, end = (
        field.sdf(points, rays.owner)[found.found].abs() for points in (found.points_obj, found.rays.at(found.depth))
    )
    assert float(here.max()) > 1e-5
    assert float(end.mean()) < 0.3 * float(here.mean())


@pytest.mark.parametrize("regime", ["disparity_offset", "track", *_long("typical")])
def test_gradients_can_be_differentiated(bench_of: BenchOf, regime: str) -> None:
    """What gradients through a refinement are made of: the derivatives of every row's gradient, by autograd."""
    names = [name for name in _differenced(regime) if name not in AT_FIXED_DEPTHS]
    with torch.no_grad():
        for found in compare(gradient_experiment(bench_of(regime), names), regime):
            assert found.broken_bounds() == []
            assert found.compared > 50


def test_a_depth_that_is_not_attached_is_seen(bench_of: BenchOf, monkeypatch: pytest.MonkeyPatch) -> None:
    """Gradients that treat the depth of the surface as a constant have wrong derivatives: the check can tell."""
    monkeypatch.setattr(photometric, "surface_depth", lambda *at: at[3])
    with torch.no_grad():
        (found,) = compare(gradient_experiment(bench_of("typical"), ["photometric"]), "typical")
    assert found.errors["analytic-numeric"] > 1e-2
