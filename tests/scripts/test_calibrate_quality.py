"""The calibration recovers what simulated cars were made of, and judges by frames it has not seen."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import calibrate_quality
import numpy as np
import pytest
import torch
from helpers.synthetic_scene import cached_street
from quality_calibration import fit, noise, observations, report
from quality_calibration.bend import Bend

from directshape_torch.cli.demo import demo_dataset
from directshape_torch.errors import DataFormatError
from directshape_torch.geometry.box3d import rotation_y_from_pose
from directshape_torch.geometry.disparity_field import polynomial_basis
from directshape_torch.refinement.quality import EVIDENCE_NAMES, trust_model_of
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.rig.estimate import RigEstimate


def simulated(count: int = 6000, frames: int = 24):
    """Cars whose overlap falls with probability sigmoid(-(2 - 1.5 x)), x the first column; errors of known scales."""
    rng = np.random.default_rng(3)
    evidence = rng.standard_normal((count, len(EVIDENCE_NAMES)))
    is_worse = rng.random(count) < 1 / (1 + np.exp(2 - 1.5 * evidence[:, 0]))
    raw = np.exp(rng.normal(-3, 1, (count, 4)))
    errors = rng.standard_normal((count, 4)) * np.sqrt((FACTORS * raw) ** 2 + FLOORS**2)
    covariance = np.zeros((count, 4, 4))
    # Straight ahead: x lies across the ray, z along it.
    for position, column in enumerate((2, 0, 1, 3)):
        covariance[:, column, column] = raw[:, position] ** 2
    return observations.Observations(
        group=np.array([f"{i % frames:06d}" for i in range(count)]),
        source=np.array(["stereo, simulated"] * count),
        evidence=evidence,
        iou_before=np.full(count, 0.7),
        iou_after=np.where(is_worse, 0.6, 0.8),
        errors=errors[:, [1, 2, 0, 3]],
        covariance=covariance,
        ray=np.tile([0.0, 1.0], (count, 1)),
    )


FACTORS, FLOORS = np.array([2.0, 1.5, 1.0, 1.0]), np.array([0.05, 0.1, 0.03, 0.02])


def test_the_weights_are_recovered() -> None:
    cars = simulated()
    head = fit.fit_head(cars.evidence, ~cars.is_worse, EVIDENCE_NAMES[:2])
    assert head.weights[0] == pytest.approx(-1.5, abs=0.12)
    assert head.weights[1] == pytest.approx(0.0, abs=0.12)
    assert head.bias == pytest.approx(2.0, abs=0.12)


def test_factors_and_floors_of_the_sigmas_are_recovered() -> None:
    errors, raw = fit.in_view(simulated())
    scales = fit.fit_sigmas(errors, raw)
    np.testing.assert_allclose(scales.factors, FACTORS, rtol=0.15)
    np.testing.assert_allclose(scales.floors, FLOORS, rtol=0.25)
    one, two = report.coverage(errors, fit.calibrated(raw, *scales))
    np.testing.assert_allclose(one, 0.683, atol=0.02)
    np.testing.assert_allclose(two, 0.954, atol=0.02)


def test_no_prediction_has_seen_its_frame() -> None:
    cars = simulated(240)

    def seen(train, test):
        assert not set(train.group.tolist()) & set(test.group.tolist())
        return np.full((len(test), 1), len(train), dtype=float)

    predictions = fit.cross_validated(cars, seen)
    assert np.unique(predictions).tolist() == [220.0]


def test_kept_cars_of_another_version_are_refused(tmp_path: Path) -> None:
    cars = simulated(12)
    replace(cars, evidence=np.pad(cars.evidence, ((0, 0), (0, 22)))).save(tmp_path / "cars.npz")
    with pytest.raises(DataFormatError, match=r"has evidence \(30,\) of each car, this version's is \(8,\); delete it"):
        observations.Observations.load(tmp_path / "cars.npz")


def judged(cars: observations.Observations, probabilities: np.ndarray) -> report.Judged:
    errors, raw = fit.in_view(cars)
    return report.Judged("cars", cars, probabilities, errors, raw)


def test_the_policy_by_hand() -> None:
    cars = replace(simulated(4), iou_before=np.full(4, 0.7), iou_after=np.array([0.9, 0.8, 0.66, 0.5]))
    # 0.66 is less, but not by 0.05; at 0.55 the second and the fourth car keep their input.
    assert cars.is_worse.tolist() == [False, False, False, True]
    found = judged(cars, np.column_stack([[0.9, 0.3, 0.6, 0.5], np.ones(4)]))
    outcome = report.policy(found, report.Thresholds(0.55, 0.9))
    assert (outcome.kept, outcome.worse) == (0.5, 0.0)
    assert outcome.iou == pytest.approx((0.9 + 0.7 + 0.66 + 0.7) / 4)
    # To lose the last car, the second must go as well; the third, a little worse, can go too.
    assert report.choose_thresholds(found) == (0.62, 0.0)


def test_drawn_detections_have_the_errors_of_their_level() -> None:
    _, scene = cached_street()
    level, detections = noise.LEVELS[1], scene.detections
    draws = [noise.noisy(detections, level, seed) for seed in range(200)]
    first = torch.stack([d.T_cam_obj[0] for d in draws])
    exact = detections.T_cam_obj[0]
    distance = float(exact[[0, 2], 3].norm())
    along = (first[:, :3, 3] - exact[:3, 3]) @ (exact[:3, 3] * torch.tensor([1.0, 0.0, 1.0]).double()) / distance
    assert float(along.std()) == pytest.approx(level.depth_share * distance, rel=0.2)
    yaw = rotation_y_from_pose(first) - rotation_y_from_pose(exact[None])
    assert float(torch.rad2deg(yaw).std()) == pytest.approx(level.yaw_deg, rel=0.2)
    assert torch.equal(draws[7].T_cam_obj, noise.noisy(detections, level, 7).T_cam_obj)
    assert all(torch.equal(d.box_2d, detections.box_2d) for d in draws[:3])
    biased = replace(level, depth_bias=-0.1)
    nearer = torch.stack([noise.noisy(detections, biased, seed).T_cam_obj[0] for seed in range(200)])
    moved = (nearer - first)[:, :3, 3].norm(dim=1)
    torch.testing.assert_close(moved, torch.full_like(moved, 0.1 * distance))


def test_a_bent_image_has_the_disparities_and_rows_of_the_bend() -> None:
    bend = Bend.drawn(1.5, 0.3, (320, 200), seed=4)
    v, u = np.mgrid[:200, :320].astype(np.float64)
    pattern = 128 + 60 * np.sin(0.15 * u + 0.05 * v) + 60 * np.sin(0.2 * v - 0.03 * u)
    bent = bend.image(pattern.astype(np.float32))
    uv = torch.from_numpy(np.stack([u, v], axis=-1)).view(-1, 2)
    offset, rows = ((polynomial_basis(uv, (320, 200)) @ c).view(200, 320).numpy() for c in bend.coefficients.T)
    assert float(np.abs(offset).max()) == pytest.approx(1.5)
    # What the bent image shows at x belonged to x + offset, one row of it less.
    u, v = u + offset, v - rows
    expected = 128 + 60 * np.sin(0.15 * u + 0.05 * v) + 60 * np.sin(0.2 * v - 0.03 * u)
    # OpenCV looks up at thirty-seconds of a pixel: this pattern changes by 16 a pixel.
    assert float(np.abs(bent - expected)[8:-8, 8:-8].max()) < 1


def test_runs_learn_of_rig_and_detector_before_they_refine() -> None:
    dataset = demo_dataset()
    seen: list[RigEstimate] = []

    def refiner(rig: RigEstimate) -> DirectShapeRefiner:
        seen.append(rig)
        return DirectShapeRefiner(rig=rig)

    cars = observations.observe_noisy(dataset, refiner, noise.LEVELS[1:2], [0, 2], "masks", lambda _: None)
    assert [len(rig.rows) > 0 for rig in seen] == [True, True]
    exact, bent = (cars.where(np.char.endswith(cars.source, f"seed {seed}")) for seed in (0, 2))
    assert min(len(exact), len(bent)) > 0
    assert all(np.isfinite(cars.evidence[:, EVIDENCE_NAMES.index("mask_misfit_left")]).all() for cars in (exact, bent))


def test_cars_that_are_kept_make_model_and_report(tmp_path: Path) -> None:
    simulated(480, frames=4).save(tmp_path / "out" / "cars_masks_0.npz")
    simulated(48, frames=4).save(tmp_path / "out" / "cars_kitti_noisy.npz")
    arguments = ["--data", ".", "--exact", ".", "--masks", "masks", "--seeds", "0"]
    arguments += ["--other", "kitti", "noisy", "m", "--out"]
    model = tmp_path / "model.json"
    assert calibrate_quality.main([*arguments, str(tmp_path / "out"), "--model", str(model)]) == 0
    made = trust_model_of(json.loads(model.read_text()))
    assert (made.provenance["cars"], made.better.columns) == (480, calibrate_quality.BETTER)
    text = (tmp_path / "out" / "report.md").read_text()
    assert text.count("| rendered, all | ") == 5
    assert "| rendered, all | 480 | " in text
    assert "| kitti noisy | 48 | " in text
