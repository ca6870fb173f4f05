"""Lookups in the steps that a compiler traces, against the others.

As Python, without a compiler: only the question whether one is at work is answered otherwise.
"""

from __future__ import annotations

import pytest
import torch
from helpers.lookup import derivatives_at, value_at
from torch import Tensor

from directshape_torch.shape.sdf_grid import GridField, GridShape

COUNT = 50


def field_of(num_codes: int = 3) -> GridField:
    """Two objects."""
    generator = torch.Generator().manual_seed(5)
    values = torch.randn(2, 5, 4, 6, generator=generator, dtype=torch.float64)
    basis = torch.randn(5, 4, 6, num_codes, generator=generator, dtype=torch.float64)
    return GridShape(values, basis, torch.tensor([-1.0, 0.5, 0.0], dtype=torch.float64), 0.4).field


def points_and_index() -> tuple[Tensor, Tensor]:
    """(3, 7, COUNT), some outside the grid, on its border and on its nodes; and objects (COUNT,)."""
    generator = torch.Generator().manual_seed(6)
    points = 2.4 * torch.rand(3, 7, COUNT, generator=generator, dtype=torch.float64) - 0.6
    points[:, 0, :4] = torch.tensor([[-1.0, 0.6, -0.6, 0.2], [0.5, 1.7, 0.9, 1.3], [0.0, 2.0, 0.4, 0.8]])
    return points, torch.arange(COUNT) % 2


@pytest.mark.parametrize("num_codes", [0, 1, 5])
@pytest.mark.parametrize("constant", [False, True])
def test_they_are_the_same(monkeypatch: pytest.MonkeyPatch, constant: bool, num_codes: int) -> None:
    field, (points, index) = field_of(num_codes), points_and_index()
    expected = derivatives_at(field, points, index)
    monkeypatch.setattr(torch.compiler, "is_compiling", lambda: True)
    for mine, theirs in zip(derivatives_at(field, points, index, constant), expected, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(value_at(field, points, index), expected.value, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("bad", [torch.nan, torch.inf, -torch.inf])
def test_points_that_are_not_finite_disturb_no_others(monkeypatch: pytest.MonkeyPatch, bad: float) -> None:
    field, (points, index) = field_of(), points_and_index()
    monkeypatch.setattr(torch.compiler, "is_compiling", lambda: True)
    clean = derivatives_at(field, points, index, constant=True)
    points[1, 3, 7] = bad
    broken = derivatives_at(field, points, index, constant=True)
    fine = torch.ones(7, COUNT, dtype=torch.bool)
    fine[3, 7] = False
    assert not broken.value[3, 7].isfinite()
    assert torch.equal(broken.value[fine], clean.value[fine])
    assert torch.equal(broken.gradient[:, fine], clean.gradient[:, fine])
    assert torch.equal(broken.J_value_code[fine], clean.J_value_code[fine])


def test_they_have_the_same_gradients(monkeypatch: pytest.MonkeyPatch) -> None:
    """By the points, the values and the basis, through value, gradient and code derivative."""

    def gradients() -> tuple[Tensor, ...]:
        field, (points, index) = field_of(), points_and_index()
        points = points[:, 1:]  # on a border there is no one derivative
        inputs = [x.clone().requires_grad_() for x in (points, field.values, field.basis)]
        at = derivatives_at(field._replace(values=inputs[1], basis=inputs[2]), inputs[0], index)
        total = sum((x * torch.linspace(-1, 1, x.numel(), dtype=x.dtype).view_as(x)).sum() for x in at)
        return torch.autograd.grad(total, inputs)

    expected = gradients()
    monkeypatch.setattr(torch.compiler, "is_compiling", lambda: True)
    for mine, theirs in zip(gradients(), expected, strict=True):
        assert theirs.abs().max() > 0.1
        torch.testing.assert_close(mine, theirs, rtol=1e-10, atol=1e-10)
