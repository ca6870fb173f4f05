"""The prior of a few parametric cars is a file that the refiner accepts."""

from __future__ import annotations

import sys
from pathlib import Path

import build_bundled_prior as script
import pytest

from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.shape.load_prior import load_prior


def test_a_prior_of_five_cars(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "prior.safetensors"
    words = ["--num-cars", "5", "--num-codes", "2", "--out", str(out)]
    monkeypatch.setattr(sys, "argv", ["build_bundled_prior", *words])
    script.main()
    refiner = DirectShapeRefiner(load_prior(out))
    assert refiner.prior.num_codes == 2
    hwl = refiner.prior.dimensions_and_derivative(refiner.prior.initial_code(1)).hwl[0]
    assert 1.2 < hwl[0] < 1.9
    assert 3.0 < hwl[2] < 5.2
