"""Single precision, skip rules and the paper's depth derivative: the measurements against what is known."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from directshape_torch.laboratory import kinks
from directshape_torch.laboratory.bench import Bench
from directshape_torch.laboratory.paper_depth import (
    DEPTH_ALONG_RAY,
    PAPER,
    UNIT_GRADIENT,
    paper_depth_errors,
    row_factors,
    scaled_linearisation,
)
from directshape_torch.laboratory.paper_refinement import CONTROL, paper_refinements
from directshape_torch.laboratory.scenes import LaboratoryScene
from directshape_torch.laboratory.single_precision import ALL_TERMS, cast, precision_loss
from directshape_torch.laboratory.skip_rules import OFF_MASK, skip_costs
from directshape_torch.laboratory.steps import gauss_newton_step, step_shift
from directshape_torch.shape.pca_prior import PCAShapePrior

BenchOf = Callable[..., Bench]


def test_paper_is_exact_for_a_unit_gradient_on_the_optical_axis() -> None:
    ray = torch.tensor([[0.0, 0.0, 1.0]])
    assert [float(f) for f in row_factors(torch.tensor([[0.6, 0.0, -0.8]]), ray).values()] == pytest.approx([1, 1, 1])


def test_paper_factors_by_hand() -> None:
    """|grad| = 0.5, |ray| = 1.25: -1 / cos = -1 / (grad . ray / 0.625), hence 0.625 times the exact one."""
    factors = row_factors(torch.tensor([[0.3, 0.0, -0.4]]), torch.tensor([[0.75, 0.0, 1.0]]))
    assert {k: float(v) for k, v in factors.items()} == pytest.approx(
        {PAPER: 0.625, UNIT_GRADIENT: 0.5, DEPTH_ALONG_RAY: 1.25}
    )


def test_factor_one_changes_nothing(bench_of: BenchOf) -> None:
    at = bench_of("typical")
    term = at.terms["photometric"]
    ones = torch.ones(len(term.fixed.pixel_index), dtype=torch.float64)  # type: ignore[attr-defined]
    exact, same, double = term.linearise(at.projected), *(scaled_linearisation(at, term, f * ones) for f in (1, 2))  # type: ignore[arg-type]
    torch.testing.assert_close(same.gradient, exact.gradient, rtol=1e-11, atol=1e-12)
    torch.testing.assert_close(same.hessian, exact.hessian, rtol=1e-11, atol=1e-12)
    torch.testing.assert_close(double.hessian, 4 * exact.hessian, rtol=1e-11, atol=1e-12)


def test_paper_errors_on_real_shapes(bench_of: BenchOf) -> None:
    found = {e.variant: e for e in paper_depth_errors(bench_of("typical"))}
    assert set(found) == {PAPER, UNIT_GRADIENT, DEPTH_ALONG_RAY}
    # A ray of unit depth is longer than one; the PCA mean's gradient is shorter than one.
    assert found[DEPTH_ALONG_RAY].factor_median > 1
    assert found[UNIT_GRADIENT].factor_median < 1
    assert 0 < found[PAPER].row_error_median < found[PAPER].row_error_max


def test_steps_compare_by_hand(bench_of: BenchOf) -> None:
    problem = bench_of("typical").problem
    step = torch.zeros(1, 8, dtype=torch.float64)
    step[0, 0], other = 0.3, torch.zeros(1, 8, dtype=torch.float64)
    other[0, 1], other[0, 4] = 0.3, 0.03
    shift = step_shift(problem, step, other)
    # Trust region 0.5 m, 0.15 rad: 0.6, 0.6, 0.2 of it.
    assert float(shift.trust_region_share) == pytest.approx(0.6)
    assert float(shift.metres) == pytest.approx(0.3 * 2**0.5)
    assert float(shift.degrees) == pytest.approx(1.7188734)
    assert float(shift.turned_deg) == pytest.approx(90.0)
    assert float(step_shift(problem, step, step).turned_deg) == 0.0


def test_the_step_is_the_solvers(bench_of: BenchOf) -> None:
    at = bench_of("typical")
    step = gauss_newton_step(at.problem, at.problem.linearise_terms(at.state))
    assert (step.abs() <= at.problem.step_limits() * (1 + 1e-12)).all()
    before, after = at.problem.cost(at.state), at.problem.cost(at.problem.retract(at.state, 1e-3 * step))
    assert (after < before).all()


def test_float32_loses_little_and_says_so(bench_of: BenchOf) -> None:
    found = {
        x.name: x for x in precision_loss(bench_of("typical"), ["photometric", "silhouette_left_product", "shape"])
    }
    assert set(found) == {"photometric", "silhouette_left_product", "shape", ALL_TERMS}
    assert 1e-9 < found["photometric"].analytic_median < 1e-4
    assert 0 < found["photometric"].step_share < 0.01
    assert found["shape"].analytic_max == 0.0
    assert found[ALL_TERMS].rows > found["photometric"].rows


def test_cast_reaches_every_tensor(bench_of: BenchOf) -> None:
    low = cast(bench_of("typical").terms["photometric"])
    assert low.fixed.rays_left.dtype == low.pyramid[0].left.dtype == low.cars.K_left.dtype == torch.float32
    assert low.fixed.pixel_index.dtype == torch.int64


def test_skip_rules_are_counted(bench_of: BenchOf) -> None:
    costs = {(c.rule, c.term): c for c in skip_costs(bench_of("typical"))}
    saturated = costs[kinks.SATURATION, "silhouette_left"]
    assert 0 < saturated.skipped < saturated.rows
    # At a saturation of 16 what is cut off is e^-16 of a row: next to nothing, but not nothing.
    assert 0 < saturated.gradient_share < 1e-3
    assert (OFF_MASK, "photometric") in costs
    grazing = {c.rule: c for c in skip_costs(bench_of("grazing"))}[kinks.GRAZING]
    assert grazing.rows > 0


def test_refinements_with_the_papers_derivative(scene: LaboratoryScene, prior: PCAShapePrior) -> None:
    """The same energy from the same starts: the two ways end near each other, and are not the same."""
    damped, control, undamped = paper_refinements(scene, prior, 2)
    assert (damped.solver, control.solver, undamped.solver) == ("damped", CONTROL, "undamped")
    assert control.iterations_exact == damped.iterations_exact
    assert 0 < control.apart_m < 0.2
    assert 1e-6 < damped.apart_m_median <= damped.apart_m < 0.2
    assert damped.iterations_exact > 1
    assert damped.cost_higher + damped.cost_lower <= damped.cars == 2
    assert undamped.iterations_exact != damped.iterations_exact
