"""Boxes of images and detector are brought together by what both are off by, and nothing else changes."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import torch
from helpers.problems import DEFAULT
from helpers.synthetic_scene import cached_street, disturbed
from torch import Tensor

from directshape_torch import DirectShapeRefiner, RigEstimate
from directshape_torch.config import BackwardConfig
from directshape_torch.refinement.fusion import fused
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.scene import Detections
from directshape_torch.status import Status

NOTHING_KNOWN = torch.full((7,), 1e6, dtype=torch.float64)
EXACT = torch.full((7,), 1e-5, dtype=torch.float64)
SOME = torch.tensor([0.01, 0.1, 0.05, 0.1, 0.2, 0.05, 0.05], dtype=torch.float64)


@lru_cache(maxsize=1)
def refined() -> tuple[RefinementResult, Detections]:
    prior, scene = cached_street()
    detections = disturbed(scene.detections)
    return DirectShapeRefiner(prior, DEFAULT)(scene.frames, detections), detections


def differences(result: RefinementResult, detections: Detections) -> Tensor:
    return fused(result, detections, None).comparison.difference


def test_a_detector_of_which_nothing_is_known_changes_nothing() -> None:
    result, detections = refined()
    for sigmas in (None, NOTHING_KNOWN):
        found = fused(result, detections, sigmas)
        torch.testing.assert_close(found.T_cam_obj, result.T_cam_obj, rtol=0, atol=1e-5)
        torch.testing.assert_close(found.code, result.code, rtol=0, atol=1e-4)
    assert result.comparison.difference.isnan().all()
    compared = fused(result, detections, None)
    assert compared.T_cam_obj.equal(result.T_cam_obj)
    assert compared.comparison.sigma_images.isfinite().all()
    assert compared.comparison.covariance.isnan().all()
    assert compared.sigma_xyz_yaw.equal(result.sigma_xyz_yaw)


def test_an_exact_detector_keeps_its_boxes() -> None:
    result, detections = refined()
    before, after = differences(result, detections), differences(fused(result, detections, EXACT), detections)
    assert before[:, :4].abs().amax() > 0.05
    assert after[:, :4].abs().amax() < 2e-3
    # Sizes come as near as shapes of the prior can.
    assert (after[:, 4:].abs() < 0.2 * before[:, 4:].abs() + 0.01).all()


def test_between_both_each_counts_by_what_it_is_known_to_be_off_by() -> None:
    result, detections = refined()
    found = fused(result, detections, SOME)
    alone = fused(result, detections, None).comparison
    origin = detections.T_cam_obj[:, :3, 3]
    detector = SOME.repeat(len(result), 1)
    detector[:, 0] *= torch.hypot(origin[:, 0], origin[:, 2])
    # Were the errors of the images independent, each quantity would move by its own share.
    share = alone.sigma_images**2 / (alone.sigma_images**2 + detector**2)
    left = differences(found, detections)
    torch.testing.assert_close(left, (1 - share) * alone.difference, rtol=0.3, atol=0.03)
    sigma = found.comparison.covariance.diagonal(dim1=1, dim2=2).sqrt()
    assert (sigma < torch.minimum(alone.sigma_images, detector) + 1e-9).all()
    assert (sigma > 0).all()
    assert found.sigma_xyz_yaw[:, 3].equal(sigma[:, 3] / 2)
    torch.testing.assert_close(found.sigma_xyz_yaw[:, 1], sigma[:, 2])


def test_cars_that_were_not_refined_or_belong_to_a_track_stay_to_the_bit() -> None:
    result, detections = refined()
    status, part = result.status_code.clone(), result.track_part.clone()
    status[0], part[1] = Status.not_trusted.code, 0
    found = fused(replace(result, status_code=status, track_part=part), detections, EXACT)
    assert found.T_cam_obj.equal(result.T_cam_obj)
    assert found.code.equal(result.code)
    assert found.comparison.difference.isnan().all()


def test_each_car_is_brought_together_by_itself() -> None:
    result, detections = refined()
    whole = fused(result, detections, SOME)
    for row in range(len(result)):
        one = fused(result[row], detections.rows(torch.tensor([row])), SOME)
        torch.testing.assert_close(one.T_cam_obj[0], whole.T_cam_obj[row], rtol=0, atol=1e-9)
        torch.testing.assert_close(one.code[0], whole.code[row], rtol=0, atol=1e-9)


def test_a_refiner_whose_rig_has_learnt_returns_what_both_say() -> None:
    prior, scene = cached_street()
    detections = disturbed(scene.detections)
    rig = RigEstimate.of_frames(scene.frames)
    refiner = DirectShapeRefiner(prior, DEFAULT, rig=rig)
    images = refiner(scene.frames, detections)
    assert images.comparison.difference.isfinite().all()
    rig.learn(scene.frames, images)
    assert len(rig.results) == len(images)
    sigmas = rig.detector_sigmas()
    together = refiner(scene.frames, detections)
    torch.testing.assert_close(together.T_cam_obj, fused(images, detections, sigmas).T_cam_obj)
    assert not together.T_cam_obj.equal(images.T_cam_obj)
    # Standard deviations that are given are a prior of the energy, and count once.
    given = replace(detections, pose_sigma=torch.full((len(detections), 4), 1e6).to(detections.T_cam_obj))
    assert refiner(scene.frames, given).comparison.covariance.isnan().all()
    alone = replace(DEFAULT, priors=replace(DEFAULT.priors, detector_weight=0.0))
    assert DirectShapeRefiner(prior, alone, rig=rig)(scene.frames, detections).T_cam_obj.equal(images.T_cam_obj)


def test_gradients_reach_the_detector_by_its_share() -> None:
    prior, scene = cached_street()
    rig = RigEstimate.of_frames(scene.frames)
    rig.add_results(torch.cat([torch.full((50, 1), 10.0), torch.full((50, 14), 0.02)], dim=1))
    config = replace(DEFAULT, backward=BackwardConfig(mode="unroll"))
    detections = disturbed(scene.detections)
    T_cam_obj = detections.T_cam_obj.clone().requires_grad_()
    result = DirectShapeRefiner(prior, config, rig=rig)(scene.frames, replace(detections, T_cam_obj=T_cam_obj))
    result.T_cam_obj[:, 0, 3].sum().backward()
    assert T_cam_obj.grad is not None
    # A detector that is off by 3 cm where the images are by 8 has most of the say.
    assert (T_cam_obj.grad[:, 0, 3] > 0.3).all()
