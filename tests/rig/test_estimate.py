"""An estimate finds field and detector within its own standard deviations, for evidence in any order."""

from __future__ import annotations

import io
import math
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from helpers.rig_rows import FIELD, SIZE_WH, estimate, rows_of_cars
from helpers.synthetic_scene import cached_street
from torch import Tensor

from directshape_torch import DirectShapeRefiner, RigEstimate
from directshape_torch.cli.demo import DEMO_FOLDER
from directshape_torch.geometry.disparity_field import polynomial_basis
from directshape_torch.io.stereo_dataset import open_dataset
from directshape_torch.rig.from_files import estimate_rigs
from directshape_torch.rig.pixels import pixel_evidence
from directshape_torch.rig.rig_file import load_rigs, save_rigs
from directshape_torch.scene.detections import Detections
from directshape_torch.state.cars import CarBatch

PLACES = torch.tensor([[200.0, 190], [450, 190], [620, 190], [800, 190], [1050, 190]], dtype=torch.float64)


def true_offset(uv: Tensor) -> Tensor:
    return polynomial_basis(uv, SIZE_WH) @ FIELD


def test_errors_are_as_large_as_the_estimate_says() -> None:
    """Standardised errors of offset, bias and noise over draws of 60 detections."""
    offsets, biases, noises = [], [], []
    for seed in range(25):
        rig = estimate(rows_of_cars(60, seed, bias=-0.02))
        mean, sigma = rig.offset_at(PLACES)
        offsets.append((mean - true_offset(PLACES)) / sigma)
        biases.append((rig.detector.bias + 0.02) / rig.detector.bias_sigma)
        noises.append(rig.detector.noise)
    z = torch.stack(offsets)
    assert 0.5 < float(z.square().mean().sqrt()) < 1.3
    assert float((z.abs() < 2).double().mean()) > 0.9
    assert 0.4 < float(torch.tensor(biases).square().mean().sqrt()) < 1.3
    assert float(torch.tensor(noises).mean()) == pytest.approx(0.03, abs=0.008)


def test_a_biased_detector_leaves_the_field_unharmed() -> None:
    rig = estimate(rows_of_cars(400, 0, bias=-0.045))
    assert rig.detector.bias == pytest.approx(-0.045, abs=2 * rig.detector.bias_sigma)
    mean, sigma = rig.offset_at(PLACES)
    assert bool(((mean - true_offset(PLACES)).abs() < 2.5 * sigma).all())
    assert float(sigma.max()) < 0.25
    assert float(rig.field.offsets(PLACES)[1].mean()) == pytest.approx(0.2, abs=0.05)


def test_order_and_portions_do_not_matter_to_the_bit() -> None:
    rows = rows_of_cars(1300, 2)
    at_once, by_and_by = estimate(rows), estimate()
    shuffled = rows[torch.randperm(len(rows), generator=torch.Generator().manual_seed(0))]
    for part in (*shuffled.split(450), rows[:200]):  # some of them again
        by_and_by.add_rows(part)
    assert torch.equal(at_once.mean, by_and_by.mean)
    assert torch.equal(at_once.covariance, by_and_by.covariance)
    assert len(by_and_by.rows) == 1000


def true_pixels() -> Tensor:
    """400 pixels of known depth over the whole image."""
    generator = torch.Generator().manual_seed(3)
    uv = torch.rand(400, 2, generator=generator, dtype=torch.float64) * (torch.tensor(SIZE_WH) - 1)
    noise = 0.1 * torch.randn(400, generator=generator, dtype=torch.float64)
    return torch.cat([uv, (true_offset(uv) + noise)[:, None], torch.full_like(noise, 0.2)[:, None]], dim=1)


def test_evidence_of_several_kinds_adds_up() -> None:
    """Pixels of known depth fix the field, and with it what detections say of the detector."""
    rig = estimate(rows_of_cars(60, 4, bias=-0.04))
    alone = rig.detector.bias_sigma
    rig.add_pixels("lidar", pixel_evidence(true_pixels(), SIZE_WH))
    mean, sigma = rig.offset_at(PLACES)
    assert float((mean - true_offset(PLACES)).abs().max()) < 0.08
    assert rig.detector.bias_sigma < 0.6 * alone
    assert rig.detector.bias == pytest.approx(-0.04, abs=2 * rig.detector.bias_sigma)
    assert "60 detections, lidar (1 frames)" in str(rig)
    once = sigma
    rig.add_pixels("lidar", pixel_evidence(true_pixels(), SIZE_WH))
    assert bool((rig.offset_at(PLACES)[1] < once).all())


def test_files_and_states_give_it_back(tmp_path: pytest.TempPathFactory) -> None:
    rig = estimate(rows_of_cars(50, 5))
    rig.add_pixels("lidar", pixel_evidence(true_pixels(), SIZE_WH))
    path = f"{tmp_path}/rig.json"
    save_rigs(path, [rig, estimate(focal_px=700.0)])
    first, second = load_rigs(path)
    assert torch.equal(first.mean, rig.mean)
    assert len(second.rows) == 0
    assert second.field.size_wh == SIZE_WH
    saved = io.BytesIO()
    torch.save(DirectShapeRefiner(rig=rig).state_dict(), saved)
    saved.seek(0)
    refiner = DirectShapeRefiner(rig=estimate())
    refiner.load_state_dict(torch.load(saved, weights_only=True))
    assert isinstance(refiner.rig, RigEstimate)
    assert torch.equal(refiner.rig.mean, rig.mean)
    assert str(refiner.rig) == str(rig)


def test_the_detectors_depth_error_becomes_its_prior_where_nobody_says_another() -> None:
    _, scene = cached_street()
    rig = estimate(rows_of_cars(60, 6))
    informed = rig.informed(scene.frames, scene.detections)
    assert informed.pose_sigma is not None
    distance = scene.detections.T_cam_obj[:, 0:3:2, 3].norm(dim=1)
    torch.testing.assert_close(
        informed.pose_sigma[:, 0] / distance, torch.full_like(distance, math.hypot(*rig.detector[:3]))
    )
    assert informed.pose_sigma[:, 1:].isinf().all()
    own = replace(scene.detections, pose_sigma=torch.ones_like(informed.pose_sigma))
    assert rig.informed(scene.frames, own) is own


def test_a_rig_that_few_cars_show_is_an_unknown_of_each_car() -> None:
    _, scene = cached_street()
    frames, d = scene.frames, scene.detections
    to_size = torch.tensor(frames.sizes[0].tolist()[::-1]) / torch.tensor(SIZE_WH)

    def informed(rig: RigEstimate, detections: Detections) -> Detections:
        return rig.informed(rig.corrected(frames), detections)

    def of_cars(count: int) -> RigEstimate:
        rig, rows = RigEstimate.of_frames(frames), rows_of_cars(count, 6)
        rig.add_rows(torch.cat([rows[:, :2] * to_size, rows[:, 2:]], dim=1))
        return rig

    few, nowhere = of_cars(29), torch.full_like(d.T_cam_obj[:1], torch.nan)
    d = replace(d, T_cam_obj=torch.cat([nowhere, d.T_cam_obj[1:]]))
    sigma = informed(few, d).offset_sigma_px
    assert sigma is not None
    seen = (frames.camera.K_left[d.frame_index] @ d.T_cam_obj[:, :3, 3:])[..., 0]
    torch.testing.assert_close(sigma[1:], few.offset_at(seen[1:, :2] / seen[1:, 2:])[1].to(sigma))
    assert float(sigma[0]) == 0
    # It stands for the field's sigma, which would else count twice.
    assert not bool(CarBatch.from_scene(few.corrected(frames), informed(few, d)).field_sigma_px[1:].any())
    assert informed(few, d).pose_sigma is not None
    fresh = informed(RigEstimate.of_frames(frames), d)
    assert fresh.pose_sigma is None
    assert fresh.offset_sigma_px is not None
    # Not where someone knows better: the caller, a field of the frames, more cars, pixels of known depth.
    own = replace(d, offset_sigma_px=torch.full_like(sigma, 0.3))
    assert informed(few, own).offset_sigma_px is own.offset_sigma_px
    assert few.informed(frames, d).offset_sigma_px is None
    assert few.informed(of_cars(28).corrected(frames), d).offset_sigma_px is None
    assert informed(of_cars(30), d).offset_sigma_px is None
    few.add_pixels("lidar", pixel_evidence(true_pixels(), SIZE_WH))
    assert informed(few, d).offset_sigma_px is None


def test_beyond_the_image_a_field_is_as_sure_as_at_its_border() -> None:
    _, scene = cached_street()
    camera = RigEstimate.of_frames(scene.frames).corrected(scene.frames).camera
    width = int(scene.frames.sizes[0, 1])
    axis, border = camera.K_left[0, 0, 2], width - 1 - camera.K_left[0, 0, 2]
    x = torch.stack([border, 5 * border, axis]) / camera.K_left[0, 0, 0]
    points = torch.stack([x, torch.zeros(3), torch.tensor([1.0, 1.0, -1.0])], dim=1)
    sigma = camera.field_sigma_px(torch.zeros(3, dtype=torch.long), points)
    torch.testing.assert_close(sigma[1], sigma[0])
    assert float(sigma[2]) < 2


def test_frames_are_taken_evenly_from_all_of_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """So that an estimate that soon knows enough has seen more than the beginning of a drive."""
    for path in (path for path in DEMO_FOLDER.rglob("000000.*") if path.is_file()):
        folder = tmp_path / path.relative_to(DEMO_FOLDER).parent
        folder.mkdir(parents=True)
        for number in range(8):
            shutil.copy(path, folder / f"{number:06d}{path.suffix}")
    monkeypatch.setattr(RigEstimate, "update", lambda *_: None)
    dataset = open_dataset("kitti", tmp_path, tmp_path / "detections/noisy_stereo", frames=[3])
    seen: list[str] = []
    (rig,) = estimate_rigs(dataset, seen.append)
    assert [int(name) for name in seen] == [0, 4, 2, 6, 1, 5, 3, 7]
    assert not len(rig.rows)
