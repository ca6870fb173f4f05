"""The bounds hold on a small draw, for every factor and term; a wrong Jacobian of any of them is seen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from directshape_torch.geometry import se3
from directshape_torch.laboratory import comparison
from directshape_torch.laboratory.bench import TERM_NAMES, Bench
from directshape_torch.laboratory.factors import FACTORS, left_jacobian
from directshape_torch.laboratory.second_derivatives import DEPTH_ONE_STEP, PIXEL_COST, second_derivatives
from directshape_torch.laboratory.subjects import forward_mode_columns
from directshape_torch.laboratory.term_experiment import term_experiment
from directshape_torch.laboratory.tracked_rows import tracked_photometric

BenchOf = Callable[..., Bench]


@pytest.mark.parametrize("factor", FACTORS)
def test_factors(bench_of: BenchOf, factor: str) -> None:
    for regime in ("typical", "near_pi_rotation"):
        (found,) = comparison.compare(FACTORS[factor](bench_of(regime)), regime)
        assert found.broken_bounds() == []
        assert found.compared > 0


def test_tracked_photometric_rows_are_those_of_the_term(bench_of: BenchOf) -> None:
    """Where a stage begins the tracked rows stand on the roots themselves, so none is lost and all are the same."""
    bench = bench_of("typical")
    (subject,) = tracked_photometric(bench).subjects
    term = bench.terms["photometric"]
    assert torch.equal(subject.usable, term.residuals(bench.projected).usable)
    expected = term.jacobian(bench.projected)
    assert (subject.norm > 0).any()
    torch.testing.assert_close(subject.analytic, expected, rtol=1e-8, atol=1e-9 * float(expected.abs().max()))


@pytest.mark.parametrize("name", ["tracked_silhouettes", "tracked_photometric"])
def test_a_wrong_tracked_row_is_seen(bench_of: BenchOf, name: str) -> None:
    experiment = FACTORS[name](bench_of("typical"))
    (subject,) = experiment.subjects
    J = subject.analytic.clone()
    J[int(subject.norm.argmax())] *= 1 + 1e-5
    (found,) = comparison.compare(replace(experiment, subjects=(replace(subject, analytic=J),)), "typical")
    assert len(found.broken_bounds()) == 2  # against autograd and against differences


@pytest.mark.parametrize("regime", ["typical", "contour"])
def test_terms(bench_of: BenchOf, regime: str) -> None:
    for found in comparison.compare(term_experiment(bench_of(regime), TERM_NAMES), regime):
        assert found.broken_bounds() == []
        assert found.compared > 0 or found.name.startswith("photometric")


def test_every_wrong_jacobian_is_seen(bench_of: BenchOf) -> None:
    """One unknown of each term with its sign flipped: the comparison by itself, without differencing again."""
    experiment = term_experiment(bench_of("contour", 2, 6), TERM_NAMES)
    for k, subject in enumerate(experiment.subjects):
        J = subject.analytic.clone()
        unknown = int(J.abs().sum(dim=0).argmax())
        J[:, unknown] *= -1
        wrong = replace(subject, analytic=J)
        error = ((wrong.analytic - wrong.autograd).abs() / wrong.norm.clamp_min(1e-300)[:, None]).max()
        assert error > 1e-3, TERM_NAMES[k]


def test_second_derivatives(bench_of: BenchOf) -> None:
    checks = {c.name: c for c in second_derivatives(bench_of("typical", 1, 6))}
    assert PIXEL_COST in checks
    assert all(c.broken_bounds() == [] for c in checks.values())
    assert all(c.compared > 30 for c in checks.values())
    # One attached Newton step has the right gradient and a wrong Hessian: the check must be able to tell.
    assert checks[DEPTH_ONE_STEP].maximum > 1e-2
    broken = replace(checks[DEPTH_ONE_STEP], bound=1e-6)
    assert "second derivative of depth" in broken.broken_bounds()[0]


@pytest.mark.parametrize("angle", [0.0, 1e-7, 0.7, 3.1415926])
def test_left_jacobian_of_the_exponential(angle: float) -> None:
    """`exp(xi + d) = exp(J_l d) exp(xi)` to first order, against autograd of the package's exponential."""
    twist = torch.tensor([[3.0, -1.0, 20.0, 0.6 * angle, -0.64 * angle, 0.48 * angle]], dtype=torch.float64)
    by_autograd = forward_mode_columns(lambda x: se3.exp(x).flatten(1), twist).reshape(4, 4, 6)
    by_hand = torch.einsum("gij,gk->ijk", se3.generators() @ se3.exp(twist), left_jacobian(twist)[0])
    torch.testing.assert_close(by_hand, by_autograd, rtol=1e-10, atol=1e-10)
