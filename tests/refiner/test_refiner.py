"""These tests check the refiner as a module: batching, order, determinism, dtypes, padding, stored state, borders."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import pytest
import torch
from helpers.ellipsoids import ellipsoid_prior
from helpers.problems import DEFAULT, PAPER
from helpers.synthetic_scene import (
    Street,
    cached_street,
    disturbed,
    joined_detections,
    joined_frames,
    select,
    street,
)
from safetensors.torch import load, save

from directshape_torch.config import RefinerConfig
from directshape_torch.errors import InputError
from directshape_torch.geometry import se3
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import FrameBatch


def refiner(config: RefinerConfig = DEFAULT) -> DirectShapeRefiner:
    return DirectShapeRefiner(cached_street()[0], config)


@lru_cache(maxsize=1)
def small_street() -> Street:
    """One car, cut off by the right border, in an image of another size."""
    return street(ellipsoid_prior(), [(4.0, 1.65, 9.0)], [0.8], size_wh=(131, 97), focal_px=130.0)


@lru_cache(maxsize=1)
def two_frames() -> tuple[FrameBatch, Detections, list[tuple[FrameBatch, Detections]]]:
    """A batch of two frames of different size, and the same frames one by one."""
    parts = [(s.frames, disturbed(s.detections, seed=i)) for i, s in enumerate((cached_street()[1], small_street()))]
    frames = joined_frames([p[0] for p in parts])
    return frames, joined_detections([p[1] for p in parts], tuple(frames.images_left.shape[2:])), parts


@lru_cache(maxsize=1)
def refined_frames() -> RefinementResult:
    """The batch refined with the default settings, which must not be changed."""
    return refiner()(*two_frames()[:2])


def assert_same(a: RefinementResult, b: RefinementResult, tolerance: float = 1e-9) -> None:
    assert a.status == b.status
    assert torch.equal(a.iterations, b.iterations)
    for name in ("T_cam_obj", "code", "cost_before", "cost_after", "t_cam_ref"):
        torch.testing.assert_close(getattr(a, name), getattr(b, name), rtol=tolerance, atol=tolerance, msg=name)
    torch.testing.assert_close(a.covariance, b.covariance, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("config", [DEFAULT, pytest.param(PAPER, marks=pytest.mark.long)], ids=["default", "paper"])
def test_a_batch_of_frames_equals_a_loop_over_them(config: RefinerConfig) -> None:
    """Frames of different sizes: padding with arbitrary values must change nothing either."""
    frames, detections, parts = two_frames()
    batch = refined_frames() if config is DEFAULT else refiner(config)(frames, detections)
    first, second = (refiner(config)(*part) for part in parts)
    assert_same(batch[[0, 1]], first)
    assert_same(batch[[2]], second)


def test_a_batch_of_cars_equals_a_loop_over_them() -> None:
    """Without occlusion, which is the only thing that one car knows of another."""
    config = replace(DEFAULT, sampling=replace(DEFAULT.sampling, occlusion=False))
    scene = cached_street()[1]
    detections = disturbed(scene.detections)
    batch = refiner(config)(scene.frames, detections)
    for i in range(2):
        alone = refiner(config)(scene.frames, select(detections, torch.tensor([i])))
        assert_same(batch[[i]], alone)


def test_permuting_cars_permutes_results() -> None:
    """Of both frames, in an order that is not its own inverse."""
    frames, detections, _ = two_frames()
    order = [1, 2, 0]
    permuted = refiner()(frames, select(detections, torch.tensor(order)))
    assert_same(permuted, refined_frames()[order])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_same_bits_twice(dtype: torch.dtype) -> None:
    frames, detections, _ = two_frames()
    module = DirectShapeRefiner(ellipsoid_prior(), DEFAULT).to(dtype)
    a, b = (module(frames.to(dtype=dtype), detections.to(dtype=dtype)) for _ in range(2))
    for name in ("T_cam_obj", "code", "cost_before", "cost_after", "covariance", "iterations", "status_code"):
        assert torch.equal(getattr(a, name), getattr(b, name)), name
    assert a.T_cam_obj.dtype == a.code.dtype == dtype


def test_refinement_brings_cars_nearer_to_the_truth() -> None:
    scene = cached_street()[1]
    before, after = torch.zeros(2), torch.zeros(2)
    for seed in range(3):
        detections = disturbed(scene.detections, seed=seed)
        result = refiner()(scene.frames, detections)
        assert all(status.is_refined for status in result.status)
        assert (result.cost_after.sum(1) <= result.cost_before.sum(1)).all()
        for total, T in ((before, detections.T_cam_obj), (after, result.T_cam_obj)):
            total += (T - scene.detections.T_cam_obj)[:, :3, 3].norm(dim=1) / 3
    assert after.mean() < 0.7 * before.mean()


def test_float32_ends_where_float64_does() -> None:
    scene = cached_street()[1]
    detections = disturbed(scene.detections)
    double = refiner()(scene.frames, detections)
    low = DirectShapeRefiner(ellipsoid_prior(), DEFAULT).to(torch.float32)
    single = low(scene.frames.to(dtype=torch.float32), detections.to(dtype=torch.float32))
    assert (single.T_cam_obj.double() - double.T_cam_obj).abs().max() < 0.05


def test_prior_lives_in_the_state_dict() -> None:
    source, target = DirectShapeRefiner(ellipsoid_prior(), DEFAULT), DirectShapeRefiner(ellipsoid_prior(), DEFAULT)
    target.prior.mean.add_(0.3)
    frames, detections, _ = two_frames()
    # Without pickles.
    target.load_state_dict(load(save(source.state_dict())))
    assert {"prior.mean", "prior.basis", "prior.origin"} <= set(source.state_dict())
    assert torch.equal(target(frames, detections).T_cam_obj, refined_frames().T_cam_obj)
    assert not list(source.parameters())


def test_inputs_are_not_written_to() -> None:
    frames, detections, _ = two_frames()
    copies = [t.clone() for t in (frames.images_left, detections.T_cam_obj, detections.mask_left.dense())]
    refiner()(frames, detections)
    for t, copy in zip((frames.images_left, detections.T_cam_obj, detections.mask_left.dense()), copies, strict=True):
        assert torch.equal(t, copy)


def test_a_rotated_right_camera_is_taken_into_account() -> None:
    T_right_cam = se3.exp(torch.tensor([-0.53, -0.003, 0.004, 0.004, -0.015, 0.01], dtype=torch.float64))
    scene = street(ellipsoid_prior(), [(0.2, 1.65, 9.0)], [2.0], T_right_cam=T_right_cam)
    detections = disturbed(scene.detections)
    right = refiner()(scene.frames, detections)
    unrotated = scene.frames.camera.T_right_cam.clone()
    unrotated[0, :3, :3] = torch.eye(3, dtype=torch.float64)
    wrong = refiner()(replace(scene.frames, camera=replace(scene.frames.camera, T_right_cam=unrotated)), detections)
    assert right.cost_after[0, :3].sum() < 0.6 * wrong.cost_after[0, :3].sum()


def test_wrong_inputs_are_named() -> None:
    scene = cached_street()[1]
    module = refiner()
    with pytest.raises(InputError, match=r"frames\.images_left: expected dtype torch\.float64"):
        module(scene.frames.to(dtype=torch.float32), scene.detections)
    with pytest.raises(InputError, match=r"detections.frame_index: expected 0..0, got 0..3"):
        module(scene.frames, replace(scene.detections, frame_index=torch.tensor([0, 3])))
    for name in ("mask_left", "mask_right"):
        small = {name: getattr(scene.detections, name).dense()[:, :50]}
        with pytest.raises(InputError, match=rf"detections\.{name}: expected masks of the \(padded\) image size"):
            module(scene.frames, replace(scene.detections, **small))
