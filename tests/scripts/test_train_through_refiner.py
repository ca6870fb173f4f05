"""Training through the refiner on a tiny street: steps lower the loss, reach every parameter and repeat by seed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
import train_through_refiner
from helpers.ellipsoids import ellipsoid_prior
from helpers.kitti_folder import write_data_set
from helpers.problems import DEFAULT
from refiner_training import box_loss, car_frames, jobs, networks, training
from torch.nn.functional import max_pool2d

from directshape_torch.config import BackwardConfig, StageConfig
from directshape_torch.io.kitti_dataset import KittiStereoDataset
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.shape.tensor_file import read_tensors


@pytest.fixture(scope="module")
def data_set(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("street")
    write_data_set(root, ("000000", "000001"))
    return root


@pytest.fixture(scope="module")
def frames(data_set: Path) -> list[object]:
    """Two frames whose masks are two pixels too large: a correction has something to learn."""
    dataset = KittiStereoDataset(data_set, data_set / "detections", data_set / "masks", dtype=torch.float64)
    parts = []
    for frame_id in dataset.frame_ids:
        loaded = dataset.load(frame_id)
        d = loaded.detections
        grown = [max_pool2d(m[:, None].double(), 5, stride=1, padding=2)[:, 0] for m in (d.mask_left, d.mask_right)]
        loaded = replace(loaded, detections=replace(d, mask_left=grown[0], mask_right=grown[1]))
        parts.append(car_frames.prepare_frame(loaded))
    return parts


def refiner(mode: str = "unroll") -> DirectShapeRefiner:
    config = replace(
        DEFAULT,
        stages=(StageConfig(1.0, 0, 12),),
        sampling=replace(DEFAULT.sampling, min_pixels=120, max_pixels=120),
        solver=replace(DEFAULT.solver, cost_tolerance=1e-9, step_tolerance=1e-6),
        backward=BackwardConfig(mode, max_remaining_step=0.1),
    )
    return DirectShapeRefiner(ellipsoid_prior(), config)


def network(kind: str, parts: str = "both", seed: int = 0) -> torch.nn.Module:
    torch.manual_seed(seed)
    made = networks.CropNetwork(parts) if kind == "network" else networks.ConstantCorrector(parts)
    return made.double()


@pytest.mark.parametrize(
    ("mode", "kind", "parts"),
    [
        ("unroll", "constant", "weights"),
        ("unroll", "network", "masks"),
        ("implicit", "constant", "masks"),
        ("implicit_gauss_newton", "network", "weights"),
    ],
)
def test_a_step_lowers_the_loss(frames: list[object], mode: str, kind: str, parts: str) -> None:
    corrector, through = network(kind, parts), refiner(mode)
    optimiser = torch.optim.Adam(corrector.parameters(), lr=0.02)
    batch = car_frames.joined(frames)
    before = training.mean_loss(through, corrector, frames)
    losses, reached = training.train_step(through, batch, corrector, optimiser)
    # Accepting by the cost may end beside the stationary point that the implicit modes ask for.
    assert reached == len(batch.rows) if mode == "unroll" else 1 <= reached <= len(batch.rows)
    assert float(losses.mean()) == pytest.approx(before, rel=1e-6)
    if mode == "unroll":
        # A car without implicit gradient has no say in the step, which may then raise the loss of all.
        assert training.mean_loss(through, corrector, frames) < before


@pytest.mark.parametrize("kind", ["constant", "network"])
def test_gradients_reach_every_parameter(frames: list[object], kind: str) -> None:
    corrector, through = network(kind), refiner()
    optimiser = torch.optim.Adam(corrector.parameters(), lr=0.02)
    batch = car_frames.joined(frames)
    # The last layers begin at zero, so that nothing is corrected; the first step opens the way to the others.
    for _ in range(2):
        training.train_step(through, batch, corrector, optimiser)
    for name, parameter in corrector.named_parameters():
        assert parameter.grad is not None, name
        assert float(parameter.grad.abs().sum()) > 0, name


def test_a_car_without_gradient_is_counted_and_moves_nothing(frames: list[object]) -> None:
    batch = car_frames.joined(frames[:1])
    unseen = torch.zeros_like(batch.detections.has_mask_left)
    blind = replace(batch, detections=replace(batch.detections, has_mask_left=unseen, has_mask_right=unseen))
    corrector = network("constant")
    optimiser = torch.optim.Adam(corrector.parameters(), lr=0.02)
    losses, reached = training.train_step(refiner(), blind, corrector, optimiser)
    assert (len(losses), reached) == (0, 0)
    assert all(bool((parameter == 0).all()) for parameter in corrector.parameters())


def test_an_epoch_without_any_gradient_is_no_failure(frames: list[object]) -> None:
    strict = refiner("implicit")
    strict.config = replace(strict.config, backward=BackwardConfig("implicit", max_remaining_step=1e-12))
    corrector = network("constant", "weights")
    settings = training.TrainingSettings(epochs=1, rate=0.01, weight_decay=0.0, frames_per_step=1, seed=0)
    (epoch,) = training.train(strict, corrector, frames[:1], [], settings)
    assert (epoch.with_gradient, epoch.without_gradient) == (0, 1)
    assert epoch.loss > 0
    assert all(bool((parameter == 0).all()) for parameter in corrector.parameters())


def test_seeds_repeat(frames: list[object]) -> None:
    def trained(seed: int) -> dict[str, torch.Tensor]:
        corrector = network("network", "weights", seed)
        settings = training.TrainingSettings(epochs=1, rate=0.01, weight_decay=0.01, frames_per_step=1, seed=seed)
        epochs = training.train(refiner(), corrector, frames, [], settings)
        assert len(epochs) == 1
        assert epochs[0].with_gradient + epochs[0].without_gradient == sum(len(f.counted) for f in frames)
        return corrector.state_dict()

    first, again, other = trained(0), trained(0), trained(1)
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert not all(torch.equal(first[name], other[name]) for name in first)


def test_corrected_masks_keep_their_gradient_and_their_surroundings() -> None:
    masks = torch.zeros(2, 20, 30, dtype=torch.float64)
    masks[:, 5:12, 8:20] = 1.0
    regions = torch.tensor([[4, 2, 24, 16], [0, 0, 0, 0]])
    nothing = torch.zeros(2, 6, 8, dtype=torch.float64)
    unchanged = networks.corrected_masks(masks, regions, nothing)
    torch.testing.assert_close(unchanged[0, 2:16, 4:24], masks[0, 2:16, 4:24].clamp(0.015, 0.985))
    residual = torch.full((2, 6, 8), -3.0, dtype=torch.float64, requires_grad=True)
    changed = networks.corrected_masks(masks, regions, residual)
    inside = changed.detach()[0, 2:16, 4:24]
    assert 0.01 < float(inside.min()) <= float(inside.max()) < 0.99
    torch.testing.assert_close(changed[1], masks[1])
    torch.testing.assert_close(changed[0, :, 24:], masks[0, :, 24:])
    assert bool((changed[0, 2:16, 4:24] < unchanged[0, 2:16, 4:24]).all())
    changed.sum().backward()
    assert residual.grad is not None
    assert bool((residual.grad[0] > 0).all())
    assert bool((residual.grad[1] == 0).all())
    assert networks.corrected_masks(masks, regions, None) is masks


def test_loss_of_boxes_is_zero_at_the_truth_and_bounded() -> None:
    true = torch.tensor([[1.0, 1.6, 20.0, 1.5, 1.7, 4.0, 0.4]], dtype=torch.float64)
    turned, lost, moved = true.clone(), true.clone(), true.clone()
    turned[0, 6] += torch.pi
    lost[0, 2] += 1000
    moved[0, 1] -= 0.5
    losses = [float(box_loss.box_losses(boxes, true)) for boxes in (true, turned, lost, moved)]
    # Lifted by 0.5 m the footprint stays, and all corners are 0.5 m off: 0 + 0.5 / (0.5 + 0.5).
    assert losses == pytest.approx([0.0, 0.0, 2.0, 0.5], abs=1e-3)


def test_folds_are_even_and_follow_the_seed() -> None:
    frame_ids = [f"{k:06d}" for k in range(12)]
    folds = jobs.folds_of(frame_ids, 3, 0)
    assert sorted(folds) == frame_ids
    assert sorted(folds.values()) == [0] * 4 + [1] * 4 + [2] * 4
    assert folds == jobs.folds_of(frame_ids, 3, 0) != jobs.folds_of(frame_ids, 3, 1)


def test_program_writes_table_curves_and_parameters(data_set: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    words = ["--data", data_set, "--detections", data_set / "detections", "--masks", data_set / "masks"]
    words += ["--out", tmp_path, "--folds", "2", "--epochs", "1", "--net", "weights", "--processes", "1"]
    assert train_through_refiner.main([str(word) for word in words]) == 0
    table = (tmp_path / "summary.md").read_text()
    for name in ("fixed default", "trained constants", "trained network"):
        assert f"| {name} |" in table
    lines = (tmp_path / "cars.csv").read_text().splitlines()
    assert [line.split(",")[0] for line in lines[1:]] == ["000000", "000001"]
    assert (tmp_path / "learning_curve.png").read_bytes().startswith(b"\x89PNG")
    factors, description = read_tensors(tmp_path / "constant_1.safetensors", train_through_refiner.SCHEMA)
    assert list(factors) == ["factors"]
    assert bool((factors["factors"] != 0).any())
    assert description["fold"] == 1


def test_missing_data_is_an_error_in_words(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--data", str(tmp_path), "--out", str(tmp_path / "out"), "--processes", "1"]
    assert train_through_refiner.main(words) == 2
    assert "training" in capsys.readouterr().err
