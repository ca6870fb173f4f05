"""The noise of the images is found again, and the table of harm is printed."""

from __future__ import annotations

from pathlib import Path

import calibrate_fusion
import numpy as np
import pytest

import directshape_torch

DEMO = Path(directshape_torch.__file__).parent / "assets" / "demo"


def test_factor_and_floor_are_found_again() -> None:
    rng = np.random.default_rng(0)
    sigma = rng.uniform(0.02, 0.4, 4000)
    error = rng.standard_t(4, 4000) * np.hypot(0.8 * sigma, 0.05)
    assert calibrate_fusion._most_likely(error, sigma) == (pytest.approx(0.8, rel=0.2), pytest.approx(0.05, rel=0.3))


def test_cars_of_the_demo_are_judged(capsys: pytest.CaptureFixture[str]) -> None:
    cars = ["--cars", str(DEMO), str(DEMO / "detections" / "noisy_stereo"), str(DEMO / "training" / "masks")]
    assert calibrate_fusion.main([*cars, "--set", "compile=off"]) == 0
    lines = capsys.readouterr().out.splitlines()
    row = next(line for line in lines if line.startswith("| demo noisy_stereo | 6 | "))
    before, alone, together = (float(row.split("|")[column].split()[0]) for column in (3, 4, 6))
    assert before < together < alone + 0.02
    assert any(line.startswith("| package | 0.47, 0.136 m | ") for line in lines)
    assert lines[-1].count("|") == 9
