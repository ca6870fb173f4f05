"""A damped step solves exactly, scales by Marquardt, handles singular and broken systems, and keeps to its region."""

from __future__ import annotations

import pytest
import torch

from directshape_torch.solver.damped_solve import damped_step, limit_step, step_size


def _systems(count: int, size: int = 5) -> tuple[torch.Tensor, torch.Tensor]:
    A = torch.randn(count, 2 * size, size, dtype=torch.float64)
    return A.mT @ A, torch.randn(count, size, dtype=torch.float64)


def test_damping_is_marquardts() -> None:
    H, g = _systems(3)
    mu = torch.tensor([0.0, 0.5, 20.0], dtype=torch.float64)
    step, _ = damped_step(H, g, mu)
    damped = H + mu[:, None, None] * torch.diag_embed(H.diagonal(dim1=1, dim2=2))
    torch.testing.assert_close(step, -torch.linalg.solve(damped, g))
    assert (step[2].abs() < step[0].abs()).float().mean() > 0.5


def test_units_do_not_matter() -> None:
    """Metres or centimetres: the step is the same step, damped or not."""
    H, g = _systems(1)
    unit = torch.tensor([1e-2, 1.0, 1e2, 1.0, 10.0], dtype=torch.float64)
    mu = torch.tensor([0.3], dtype=torch.float64)
    step, _ = damped_step(H, g, mu)
    scaled, _ = damped_step(H * unit[:, None] * unit, g * unit, mu)
    torch.testing.assert_close(scaled * unit, step, rtol=1e-9, atol=0)


def test_a_singular_system_has_no_step_and_touches_no_other() -> None:
    H, g = _systems(3)
    row = torch.randn(5, dtype=torch.float64)
    broken = H.clone()
    broken[1] = row[:, None] * row
    step, solvable = damped_step(broken, g, torch.zeros(3, dtype=torch.float64))
    assert solvable.tolist() == [True, False, True]
    assert (step[1] == 0).all()
    expected, _ = damped_step(H, g, torch.zeros(3, dtype=torch.float64))
    assert (step[[0, 2]] == expected[[0, 2]]).all()


def test_damping_makes_an_unseen_direction_solvable() -> None:
    H = torch.diag(torch.tensor([4.0, 0.0, 1.0], dtype=torch.float64))[None]
    g = torch.tensor([[4.0, 0.0, 1.0]], dtype=torch.float64)
    assert not damped_step(H, g, torch.zeros(1, dtype=torch.float64))[1].any()
    step, solvable = damped_step(H, g, torch.tensor([0.1], dtype=torch.float64))
    assert solvable.all()
    torch.testing.assert_close(step, torch.tensor([[-1 / 1.1, 0.0, -1 / 1.1]], dtype=torch.float64))


@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
@pytest.mark.parametrize("where", ["hessian", "gradient"])
def test_what_is_not_finite_is_not_solvable(bad: float, where: str) -> None:
    H, g = _systems(2)
    (H if where == "hessian" else g)[0, 2] = bad
    step, solvable = damped_step(H, g, torch.zeros(2, dtype=torch.float64))
    assert solvable.tolist() == [False, True]
    assert step.isfinite().all()


def test_the_whole_step_is_scaled() -> None:
    limits = torch.tensor([0.5, 0.5, 0.15], dtype=torch.float64)
    steps = torch.tensor([[0.1, 0.2, 0.05], [2.0, 0.1, 0.0], [0.1, 0.0, -0.6]], dtype=torch.float64)
    limited = limit_step(steps, step_size(steps, limits))
    # Untouched; a quarter of it; a quarter of it.
    expected = torch.stack([steps[0], steps[1] / 4, steps[2] / 4])
    torch.testing.assert_close(limited, expected)
