"""Boxes of images and detector are combined by the errors of both, and nothing else changes."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import torch
from helpers.problems import DEFAULT
from helpers.synthetic_scene import cached_street, disturbed
from torch import Tensor

from directshape_torch import DirectShapeRefiner, RigEstimate
from directshape_torch.config import BackwardConfig, RigConfig
from directshape_torch.geometry.disparity_field import DisparityField
from directshape_torch.refinement.fusion import UNKNOWN_DETECTOR, compared, fused, noise_of_boxes
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.refinement.trust import bundled_trust_model
from directshape_torch.scene.detections import Detections
from directshape_torch.state.cars import CarBatch
from directshape_torch.status import Status

TOGETHER = replace(DEFAULT, priors=replace(DEFAULT.priors, detector_weight=1.0))
NOTHING_KNOWN = torch.full((7,), 1e6, dtype=torch.float64)
EXACT = torch.full((7,), 1e-5, dtype=torch.float64)
SOME = torch.tensor([0.01, 0.1, 0.05, 0.1, 0.2, 0.05, 0.05], dtype=torch.float64)
NOISE = bundled_trust_model().image_noise


@lru_cache(maxsize=1)
def refined() -> tuple[RefinementResult, Detections]:
    prior, scene = cached_street()
    detections = disturbed(scene.detections)
    return DirectShapeRefiner(prior, DEFAULT)(scene.frames, detections), detections


def cars_of(detections: Detections, sigmas: Tensor | None) -> CarBatch:
    noise = None if sigmas is None else noise_of_boxes(sigmas, detections.T_cam_obj)
    return replace(CarBatch.from_scene(cached_street()[1].frames, detections), detector_noise=noise)


def brought_together(result: RefinementResult, detections: Detections, sigmas: Tensor | None) -> RefinementResult:
    cars = cars_of(detections, sigmas)
    return fused(replace(result, comparison=compared(result, cars, NOISE)), cars)


def differences(result: RefinementResult, detections: Detections) -> Tensor:
    return compared(result, cars_of(detections, None), NOISE).difference


def test_a_detector_of_which_nothing_is_known_changes_nothing() -> None:
    result, detections = refined()
    for sigmas in (None, NOTHING_KNOWN):
        found = brought_together(result, detections, sigmas)
        torch.testing.assert_close(found.T_cam_obj, result.T_cam_obj, rtol=0, atol=1e-5)
        torch.testing.assert_close(found.code, result.code, rtol=0, atol=1e-4)
    assert brought_together(result, detections, None).T_cam_obj.equal(result.T_cam_obj)
    assert result.comparison.distance_in_sigmas.isnan().all()
    of_images = result.comparison.covariance.diagonal(dim1=1, dim2=2).sqrt()
    torch.testing.assert_close(of_images, result.comparison.sigma_images)
    torch.testing.assert_close(result.sigma_xyz_yaw[:, 3], of_images[:, 3] / 2)


def test_an_exact_detector_keeps_its_boxes() -> None:
    result, detections = refined()
    before = differences(result, detections)
    after = differences(brought_together(result, detections, EXACT), detections)
    assert before[:, :4].abs().amax() > 0.05
    assert after[:, :4].abs().amax() < 2e-3
    # Sizes come as near as shapes of the prior can.
    assert (after[:, 4:].abs() < 0.2 * before[:, 4:].abs() + 0.01).all()


def test_between_both_each_counts_by_what_it_is_known_to_be_off_by() -> None:
    result, detections = refined()
    found = brought_together(result, detections, SOME)
    detector, alone = noise_of_boxes(SOME, detections.T_cam_obj), result.comparison
    # Were the errors of the images independent, each quantity would move by its own share.
    share = alone.sigma_images**2 / (alone.sigma_images**2 + detector**2)
    left = differences(found, detections)
    torch.testing.assert_close(left, (1 - share) * alone.difference, rtol=0.3, atol=0.03)
    comparison = found.comparison
    sigma = comparison.covariance.diagonal(dim1=1, dim2=2).sqrt()
    assert (sigma < torch.minimum(alone.sigma_images, detector) + 1e-9).all()
    assert (sigma > 0).all()
    # Were they independent, the squared distance would be a sum.
    expected = (alone.difference**2 / (alone.sigma_images**2 + detector**2)).sum(dim=1).sqrt()
    torch.testing.assert_close(comparison.distance_in_sigmas, expected, rtol=0.3, atol=0.1)


def test_cars_that_were_not_refined_or_belong_to_a_track_stay_to_the_bit() -> None:
    result, detections = refined()
    status, part = result.status_code.clone(), result.track_part.clone()
    status[0], part[1] = Status.not_trusted.code, 0
    found = brought_together(replace(result, status_code=status, track_part=part), detections, EXACT)
    assert found.T_cam_obj.equal(result.T_cam_obj)
    assert found.code.equal(result.code)


def test_each_car_is_brought_together_by_itself() -> None:
    result, detections = refined()
    whole = brought_together(result, detections, SOME)
    for row in range(len(result)):
        one = brought_together(result[row], detections.rows(torch.tensor([row])), SOME)
        torch.testing.assert_close(one.T_cam_obj[0], whole.T_cam_obj[row], rtol=0, atol=1e-9)
        torch.testing.assert_close(one.code[0], whole.code[row], rtol=0, atol=1e-9)


def test_a_refiner_whose_rig_has_learnt_returns_what_both_say() -> None:
    prior, scene = cached_street()
    detections = disturbed(scene.detections)
    rig = RigEstimate.of_frames(scene.frames)
    images = DirectShapeRefiner(prior, DEFAULT, rig=rig)(scene.frames, detections)
    # Before anything is learnt the detector is taken to be as most are.
    refiner = DirectShapeRefiner(prior, TOGETHER, rig=rig)
    first = refiner(scene.frames, detections)
    expected = brought_together(images, detections, UNKNOWN_DETECTOR)
    torch.testing.assert_close(first.T_cam_obj, expected.T_cam_obj)
    torch.testing.assert_close(first.comparison.difference, images.comparison.difference)
    rig.learn(scene.frames, first)
    assert len(rig.results) == len(images)
    together = refiner(scene.frames, detections)
    expected = brought_together(images, detections, rig.detector_sigmas())
    torch.testing.assert_close(together.T_cam_obj, expected.T_cam_obj)
    assert not together.T_cam_obj.equal(first.T_cam_obj)
    # Standard deviations that are given are a prior of the energy, and count once.
    given = replace(detections, pose_sigma=torch.full((len(detections), 4), 1e6).to(detections.T_cam_obj))
    assert (refiner(scene.frames, given).comparison.gain == 0).all()


def test_without_a_rig_cameras_may_be_off_and_detectors_are_as_most_are() -> None:
    prior, scene = cached_street()
    detections = disturbed(scene.detections)
    unknown = replace(TOGETHER, rig=RigConfig())
    exact, by_default = (DirectShapeRefiner(prior, config)(scene.frames, detections) for config in (TOGETHER, unknown))
    sigmas = [result.comparison.sigma_images[:, 0] for result in (exact, by_default)]
    assert (sigmas[1] > 1.1 * sigmas[0]).all()
    assert (by_default.comparison.gain.flatten(1) != 0).any(dim=1).all()
    # Whoever knows the rig is heard.
    offset = torch.full((len(detections),), 0.3, dtype=torch.float64)
    said = DirectShapeRefiner(prior, TOGETHER)(scene.frames, replace(detections, offset_sigma_px=offset))
    torch.testing.assert_close(by_default.T_cam_obj, said.T_cam_obj)
    K, T = scene.frames.camera.K_left[0], scene.frames.camera.T_right_cam[0]
    height, width = scene.frames.sizes[0].tolist()
    field = DisparityField.constant(0.0, (width, height), K, scene.frames.camera.K_right[0], T)
    known = replace(scene.frames, camera=replace(scene.frames.camera, disparity_field=field))
    torch.testing.assert_close(DirectShapeRefiner(prior, unknown)(known, detections).T_cam_obj, exact.T_cam_obj)


def test_gradients_reach_the_detector_by_its_share() -> None:
    prior, scene = cached_street()
    rig = RigEstimate.of_frames(scene.frames)
    rig.add_results(torch.cat([torch.full((50, 1), 10.0), torch.full((50, 14), 0.02)], dim=1))
    config = replace(TOGETHER, backward=BackwardConfig(mode="unroll"))
    detections = disturbed(scene.detections)
    T_cam_obj = detections.T_cam_obj.clone().requires_grad_()
    result = DirectShapeRefiner(prior, config, rig=rig)(scene.frames, replace(detections, T_cam_obj=T_cam_obj))
    result.T_cam_obj[:, 0, 3].sum().backward()
    assert T_cam_obj.grad is not None
    # A detector that is off by 3 cm where the images are by 8 has most of the say.
    assert (T_cam_obj.grad[:, 0, 3] > 0.3).all()
