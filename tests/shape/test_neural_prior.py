"""The network prior agrees with its formula by hand, is symmetric, and can be trained through the field."""

from __future__ import annotations

import math

import pytest
import torch

from directshape_torch.errors import InputError
from directshape_torch.shape.neural_prior import MIRROR_ROUNDING_M, NeuralShapePrior
from directshape_torch.shape.prior_file import PriorProvenance

MADE = PriorProvenance("a test", "Apache-2.0", 1)
ORIGIN = torch.tensor([-2.0, -2.0, -1.0], dtype=torch.float64)


def small_prior(num_codes: int = 2) -> NeuralShapePrior:
    return NeuralShapePrior([6, 5], num_codes, ORIGIN, (9, 6, 5), 0.5, MADE)


def test_one_unit_by_hand() -> None:
    prior = NeuralShapePrior([1, 1], 1, ORIGIN, (9, 6, 5), 0.5, MADE)
    first, second, last = prior.coded_layers()
    for parameter, value in (
        (first.weight, [[0.5, 0.0, 1.0]]), (first.code_weight, [[0.2]]), (first.bias, [0.1]),
        (second.weight, [[2.0]]), (second.code_weight, [[0.0]]), (second.bias, [-0.3]),
        (last.weight, [[3.0]]), (last.code_weight, [[0.4]]), (last.bias, [0.05]),
    ):  # fmt: skip
        parameter.copy_(torch.tensor(value))
    code = torch.tensor([[1.5]], dtype=torch.float64)
    point = torch.tensor([[0.8, -1.0, 0.6]], dtype=torch.float64)
    a = 0.5 * 0.8 + math.hypot(0.6, MIRROR_ROUNDING_M) + 0.2 * 1.5 + 0.1
    b = 2.0 * math.sin(a) - 0.3
    expected = 3.0 * b / (1 + math.exp(-b)) + 0.4 * 1.5 + 0.05
    assert prior.bind(code).value(point, torch.tensor([0])).item() == pytest.approx(expected, abs=1e-7)


def test_dimensions_are_a_quadratic_whose_derivative_is_autograds() -> None:
    prior = small_prior()
    mean, linear, quadratic = (
        getattr(prior, f"dimensions_{part}_hwl").normal_() for part in ("mean", "linear", "quadratic")
    )
    code = torch.randn(2, dtype=torch.float64)

    def hwl(code: torch.Tensor) -> torch.Tensor:
        return mean + linear @ code + torch.stack([code @ matrix @ code for matrix in quadratic])

    at = prior.dimensions_and_derivative(code[None])
    torch.testing.assert_close(at.hwl[0], hwl(code))
    torch.testing.assert_close(at.J_hwl_code[0], torch.func.jacrev(hwl)(code))


def test_points_beyond_one_part_are_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    prior = small_prior()
    shape = prior.bind(torch.randn(3, 2, dtype=torch.float64))
    points, index = torch.randn(40, 3, dtype=torch.float64), torch.arange(40) % 3
    whole = shape.value_and_derivatives(points, index)
    monkeypatch.setattr("directshape_torch.shape.neural_prior._CHUNK_POINTS", 7)
    parts = shape.value_and_derivatives(points, index)
    for name in ("value", "gradient", "J_value_code"):
        torch.testing.assert_close(getattr(parts, name), getattr(whole, name))
    torch.testing.assert_close(shape.value(points, index), whole.value)


def test_weights_are_frozen_until_they_are_thawed() -> None:
    prior = small_prior()
    assert not any(p.requires_grad for p in prior.parameters())
    prior.requires_grad_()
    shape = prior.bind(prior.initial_code(1))
    points, index = torch.zeros(1, 3, dtype=torch.float64), torch.tensor([0])
    (shape.value(points, index).sum() + shape.value_and_derivatives(points, index).gradient.sum()).backward()
    for name, parameter in prior.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name


def test_wrong_settings_are_named() -> None:
    with pytest.raises(InputError, match="layer_widths, num_codes: expected at least one each"):
        NeuralShapePrior([], 2, ORIGIN, (9, 6, 5), 0.5, MADE)
    with pytest.raises(InputError, match="grid_shape, spacing_m: expected two nodes"):
        NeuralShapePrior([4], 2, ORIGIN, (9, 1, 5), 0.5, MADE)
    with pytest.raises(InputError, match=r"code: expected shape \(B, 2\)"):
        small_prior().bind(torch.zeros(1, 3, dtype=torch.float64))
