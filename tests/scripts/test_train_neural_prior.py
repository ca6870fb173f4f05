"""The training of the neural prior on a few cars gives white codes, fitted dimensions, and the same bytes twice."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch
import train_neural_prior as script

from directshape_torch.shape.neural_prior import NeuralShapePrior
from directshape_torch.shape.prior_file import PriorProvenance

MADE = PriorProvenance("a test", "Apache-2.0", 20)


def small_prior() -> NeuralShapePrior:
    origin = torch.tensor(script.GRID.origin, dtype=torch.float64)
    return NeuralShapePrior([8, 8], 2, origin, script.GRID.shape, script.GRID.spacing_m, MADE)


def test_whitening_changes_codes_but_no_shape() -> None:
    prior = small_prior()
    code = torch.randn(50, 2, dtype=torch.float64) @ torch.tensor([[2.0, 0.3], [0.0, 0.7]]).double() + 0.4
    points, index = torch.rand(50, 3, dtype=torch.float64), torch.arange(50)
    before = prior.bind(code).value(points, index)
    white = script.whiten(prior, code)
    torch.testing.assert_close(white.mean(0), torch.zeros(2, dtype=torch.float64), atol=1e-12, rtol=0)
    torch.testing.assert_close(white.T.cov(), torch.eye(2, dtype=torch.float64))
    torch.testing.assert_close(prior.bind(white).value(points, index), before)


def test_dimensions_that_are_quadratic_in_the_code_are_found() -> None:
    prior = small_prior()
    code = torch.randn(20, 2, dtype=torch.float64)
    axes = [
        torch.arange(n) * script.GRID.spacing_m + o for n, o in zip(script.GRID.shape, script.GRID.origin, strict=True)
    ]
    nodes = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).double()
    length = 4.0 + 0.2 * code[:, 0] + 0.05 * code[:, 0] * code[:, 1]
    # A slab that is `length` long: its other extents cross the grid, so only the length is a real measure.
    half = torch.stack([0.5 * length, torch.full_like(length, 0.7), torch.full_like(length, 0.8)], dim=1)
    centred = nodes - torch.tensor([0.0, -0.7, 0.0])
    grids = (centred.abs() - half[:, None, None, None]).amax(-1)
    residual = script.fit_dimensions(prior, code, grids)
    assert residual.abs().max() < 1e-6
    at = prior.dimensions_and_derivative(torch.zeros(1, 2, dtype=torch.float64))
    torch.testing.assert_close(at.hwl[0], torch.tensor([1.4, 1.6, 4.0], dtype=torch.float64), atol=1e-6, rtol=0)
    torch.testing.assert_close(at.J_hwl_code[0, 2, 0], torch.tensor(0.2, dtype=torch.float64), atol=1e-6, rtol=0)


# Nothing that looks like a car comes of so few steps.
@pytest.mark.filterwarnings("ignore::directshape_torch.errors.PriorWarning")
def test_training_lowers_the_error_and_repeats_to_the_byte(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(script, "NEAR_POINTS", 300)
    monkeypatch.setattr(script, "FAR_POINTS", 100)
    files = [tmp_path / "first.safetensors", tmp_path / "second.safetensors"]
    for file in files:
        words = ["--num-cars", "4", "--num-codes", "2", "--layer-widths", "12", "12", "--steps", "200"]
        monkeypatch.setattr(sys, "argv", ["train", *words, "--out", str(file)])
        script.main()
    assert files[0].read_bytes() == files[1].read_bytes()
    prior = NeuralShapePrior.load(files[0])
    assert prior.provenance.num_samples == 4
    assert "seed 0, 200 steps" in prior.provenance.remarks
    cars = script.make_cars(4)
    error = (
        prior.bind(prior.initial_code(1)).value(cars.points[0], torch.zeros(400, dtype=torch.long)) - cars.sdf[0]
    ).abs()
    torch.manual_seed(0)
    origin = torch.tensor(script.GRID.origin, dtype=torch.float32)
    fresh = NeuralShapePrior([12, 12], 2, origin, script.GRID.shape, script.GRID.spacing_m, MADE)
    start = (
        fresh.bind(fresh.initial_code(1)).value(cars.points[0], torch.zeros(400, dtype=torch.long)) - cars.sdf[0]
    ).abs()
    assert error.median() < 0.5 * start.median()
