"""What inexact Jacobians do to a step: the measurements against what is known."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from directshape_torch.laboratory.bench import Bench
from directshape_torch.laboratory.step_errors import (
    ALL_TERMS,
    DEPTH_ALONG_RAY,
    PAPER,
    UNIT_GRADIENT,
    angle_deg,
    energy_of,
    first_step,
    paper_depth_errors,
    row_factors,
    single_precision_errors,
    step_error,
)

BenchOf = Callable[..., Bench]


def test_paper_factors_by_hand() -> None:
    """|grad| = 0.5, |ray| = 1.25: -1 / cos = -1 / (grad . ray / 0.625), hence 0.625 times the exact one."""
    factors = row_factors(torch.tensor([0.3, 0.0, -0.4]), torch.tensor([0.75, 0.0, 1.0]))
    assert {k: float(v) for k, v in factors.items()} == pytest.approx(
        {PAPER: 0.625, UNIT_GRADIENT: 0.5, DEPTH_ALONG_RAY: 1.25}
    )
    exact = row_factors(torch.tensor([0.6, 0.0, -0.8]), torch.tensor([0.0, 0.0, 1.0]))
    assert [float(f) for f in exact.values()] == pytest.approx([1, 1, 1])


def test_paper_errors_on_real_shapes(bench_of: BenchOf) -> None:
    found = {e.cause: e for e in paper_depth_errors(bench_of("typical"))}
    assert set(found) == {PAPER, UNIT_GRADIENT, DEPTH_ALONG_RAY}
    for error in found.values():
        assert 0 < error.row_error_median < error.row_error_max < 1
        assert 0 < error.turned_deg < 90
        assert 0 < error.gradient_error_median < 1


def test_exact_rows_change_nothing(bench_of: BenchOf) -> None:
    bench = bench_of("typical")
    same = step_error(bench, "none", "photometric", {"photometric": bench.rows["photometric"]})
    assert same.row_error_max == same.gradient_error_median == same.step_share == same.turned_deg == 0.0
    assert same.rows > 0


def test_the_step_is_the_solvers(bench_of: BenchOf) -> None:
    bench = bench_of("typical")
    step = first_step(bench, {name: bench.rows[name] for name in energy_of(bench)})
    assert (step.abs() <= bench.stage.step_limits() * (1 + 1e-12)).all()
    moved = bench.problem.look(bench.stage.retract(bench.state, 1e-3 * step))
    in_use = [name != "point_cloud" for name in bench.problem.term_names]
    before, after = (bench.stage.figures(sight).term_costs[:, in_use].sum(dim=1) for sight in (bench.sight, moved))
    assert (after < before).all()


def test_float32_loses_little_and_says_so(bench_of: BenchOf) -> None:
    found = {x.term: x for x in single_precision_errors(bench_of("typical"))}
    assert set(found) == {*energy_of(bench_of("typical")), ALL_TERMS}
    assert 1e-9 < found["photometric"].row_error_median < 1e-4
    assert 0 < found["photometric"].step_share < 0.01
    assert found["shape"].row_error_max == 0.0
    assert found[ALL_TERMS].rows > found["photometric"].rows


def test_angles_by_hand() -> None:
    a = torch.tensor([[0.6, 0.0], [1.0, 0.0], [1.0, 1e-9]], dtype=torch.float64)
    b = torch.tensor([[0.0, 0.6], [3.0, 0.0], [1.0, 0.0]], dtype=torch.float64)
    assert angle_deg(a, b).tolist() == pytest.approx([90.0, 0.0, 5.7295780e-8])
