"""The noise of the images and the regression are recovered, and tables of harm and reliability are printed."""

from __future__ import annotations

import json
from pathlib import Path

import calibrate_trust
import numpy as np
import pytest
from helpers.bundled_frame import DEMO, MASKS
from trust_calibration.cars import Cars
from trust_calibration.fit import fit_head, logistic, most_likely

from directshape_torch.io.kitti_labels import read_objects
from directshape_torch.refinement.trust import trust_model_of


def test_factor_and_floor_are_found_again() -> None:
    rng = np.random.default_rng(0)
    sigma = rng.uniform(0.02, 0.4, 4000)
    error = rng.standard_t(4, 4000) * np.hypot(0.8 * sigma, 0.05)
    weight = np.full(4000, 1 / 4000)
    assert most_likely(error, sigma, weight) == (pytest.approx(0.8, rel=0.2), pytest.approx(0.05, rel=0.3))


def test_the_weights_are_found_again() -> None:
    rng = np.random.default_rng(0)
    X = rng.standard_normal((6000, 3))
    y = (rng.random(6000) < 1 / (1 + np.exp(-(2 - 1.5 * X[:, 0])))).astype(float)
    weights, bias = logistic(X, y)
    np.testing.assert_allclose(weights, [-1.5, 0, 0], atol=0.12)
    assert bias == pytest.approx(2.0, abs=0.12)


def test_one_mask_in_twenty_is_of_no_car_whatever_the_sample_has() -> None:
    rng = np.random.default_rng(0)
    for there, not_there in ((1000, 1000), (1000, 100)):
        head = fit_head(rng.standard_normal((there, 3)), rng.standard_normal((not_there, 3)))
        assert 1 / (1 + np.exp(-head.bias)) == pytest.approx(0.95, abs=0.01)


def test_a_row_is_judged_by_other_roots_with_other_detectors() -> None:
    pairs = [("a", "stereo"), ("a", "mono"), ("b", "stereo"), ("b", "mono"), ("b", "lidar")]
    runs = [Cars(root, detector, [], [], by_frame=False) for root, detector in pairs]
    found = [(run.root, run.detector) for run in calibrate_trust.others_of(runs, ("a", "stereo"))]
    assert found == [("b", "mono"), ("b", "lidar")]


def test_cars_of_the_demo_are_judged(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    cars = ["--cars", str(DEMO), "stereo", str(MASKS), "--draws", "2", "--workers", "1", "--out", str(tmp_path)]
    # The demo has one frame, and so nothing elsewhere: the model of the package says what is there.
    assert calibrate_trust.main(cars) == 0
    lines = capsys.readouterr().out.splitlines()
    row = next(line for line in lines if line.startswith("| demo stereo | 2, 6 | "))
    before, alone, together = (float(row.split("|")[column].split()[0]) for column in (3, 4, 5))
    assert before < together < alone + 0.05
    assert sum(line.startswith("| 0.") for line in lines) == 6
    limits = next(line for line in lines if line.startswith("| better from 0.5, not worse from | 0 | 0.7 |"))
    of_row = lines[lines.index(limits) + 2].split("|")
    assert of_row[1] == " demo stereo "
    assert before <= float(of_row[7].split()[0]) <= float(of_row[2].split()[0]) + 0.05
    first, second = (read_objects(tmp_path / f"demo_stereo_{seed}" / "data" / "000000.txt") for seed in (0, 1))
    assert len(first) == len(second) == 6
    assert first[0].location_ref != second[0].location_ref
    assert trust_model_of(json.loads((tmp_path / "trust_model.json").read_text())).provenance["runs"] == ["demo stereo"]
