"""The odds of the front are found again, and a run without labels or senses is named."""

from __future__ import annotations

from pathlib import Path

import calibrate_heading
import numpy as np
import pytest
from calibrate_heading import Cars, difference_of, fitted, probability, reliability
from helpers.bundled_frame import DEMO, MASKS

from directshape_torch.cli.main import main as directshape


def cars(root: str, scale: float, count: int = 4000) -> Cars:
    rng = np.random.default_rng(len(root))
    difference = rng.exponential(0.5, count)
    is_right = rng.random(count) < probability(difference, scale)
    return Cars(root, "run", difference, is_right, np.full(count, 30.0))


def test_the_fit_is_found_again_whatever_the_numbers_of_cars() -> None:
    assert fitted([cars("many", 0.05), cars("few", 0.05, 1500)]) == pytest.approx(0.05, rel=0.15)


def test_a_probability_gives_its_difference_back() -> None:
    difference = np.array([-3.0, -0.02, 0.0, 0.5, 40.0])
    np.testing.assert_allclose(difference_of(probability(difference, 0.1), 0.1), difference, rtol=1e-6, atol=1e-12)


def test_the_table_has_predicted_beside_true_shares() -> None:
    table = reliability([Cars("a", "b", np.zeros(4), np.array([True, True, True, False]), np.zeros(4))], [0.1], "")
    assert table.splitlines()[-1].startswith("| a b | 4 | 0.75 | 0.75 (4) | 0.69 | 0.50, 0.75 (4) |")


def test_the_demo_from_its_masks_is_judged(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    masks = ["--masks", str(MASKS)]
    assert directshape(["refine", "--data", str(DEMO), *masks, "--out", str(tmp_path / "run")]) == 0
    assert calibrate_heading.main(["--run", str(DEMO), str(tmp_path / "run")]) == 0
    assert "| demo run | " in capsys.readouterr().out.splitlines()[-1]
    assert calibrate_heading.main(["--run", str(DEMO), str(tmp_path)]) == 2
    assert "--run: expected a run from masks with counted cars" in capsys.readouterr().err
