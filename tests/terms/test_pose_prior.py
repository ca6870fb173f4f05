"""These tests check the detector's pose prior: the source of its standard deviations, and its effect on results."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from typing import Any

import pytest
import torch
from helpers.derivatives import moved
from helpers.problems import DEFAULT, begun_stage, figures_at
from helpers.street_inputs import SETTLED, StreetInputs, gradient_by, summary, with_mode
from helpers.synthetic_scene import cached_street, disturbed
from torch import Tensor

from directshape_torch.config import RefinerConfig, StageConfig
from directshape_torch.errors import InputError
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.scene.detections import Detections
from directshape_torch.state.cars import CarBatch
from directshape_torch.terms.priors import detector_pose_sigma

SIGMA = torch.tensor([0.3, 0.1, 0.05, 0.06], dtype=torch.float64)


def _refined(detections: Detections, config: RefinerConfig = DEFAULT) -> RefinementResult:
    prior, scene = cached_street()
    result: RefinementResult = DirectShapeRefiner(prior, config)(scene.frames, detections)
    return result


def _start(pose_sigma: Tensor | None = None) -> Detections:
    return replace(disturbed(cached_street()[1].detections), pose_sigma=pose_sigma)


@cache
def _plain() -> RefinementResult:
    """The result without standard deviations, which must not be changed."""
    return _refined(_start())


def _with_sigmas(config: RefinerConfig = DEFAULT, weight: float = 1.0, **sigmas: float) -> RefinerConfig:
    named: dict[str, Any] = {f"pose_sigma_{name}": value for name, value in sigmas.items()}
    return replace(config, priors=replace(config.priors, pose_weight=weight, **named))


def test_without_standard_deviations_there_is_no_such_term() -> None:
    plain = _plain()
    assert "pose" not in plain.term_names
    heavy = _refined(_start(), _with_sigmas(weight=1e6))
    assert heavy.term_names == plain.term_names
    assert torch.equal(heavy.T_cam_obj, plain.T_cam_obj)
    assert torch.equal(heavy.code, plain.code)
    assert "pose" not in _refined(_start(SIGMA.expand(2, 4)), _with_sigmas(weight=0.0)).term_names


def test_the_settings_say_the_same_as_the_detections() -> None:
    prior, scene = cached_street()
    start = _start()
    along = 0.02 * start.T_cam_obj[:, [0, 2], 3].norm(dim=1)
    rest = torch.tensor([0.1, math.inf, math.radians(4.0)], dtype=torch.float64).expand(2, 3)
    given = _start(torch.cat([along[:, None], rest], dim=1))
    settings = _with_sigmas(along_share=0.02, across_m=0.1, yaw_deg=4.0)
    away = torch.tensor([0.3, -0.1, 0.2, 0.0, 0.1, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64).expand(2, 9)
    costs = []
    for detections, config in ((given, _with_sigmas()), (start, settings)):
        stage, state = begun_stage(prior, scene.frames, detections, config)
        assert stage.problem.term_names[-1] == "pose"
        costs.append(figures_at(stage, moved(state, away)).term_costs[:, -1])
    torch.testing.assert_close(costs[0], costs[1], rtol=1e-12, atol=0)
    assert costs[0].min() > 1
    assert (_refined(start, settings).T_cam_obj - _plain().T_cam_obj).abs().max() > 1e-3


def test_a_detector_without_error_gets_its_pose_back_and_one_without_knowledge_the_usual_result() -> None:
    start = _start()
    exact = _refined(replace(start, pose_sigma=torch.full((2, 4), 1e-5, dtype=torch.float64)))
    assert bool(exact.refined.all())
    assert (exact.T_cam_obj[:, :3, 3] - start.T_cam_obj[:, :3, 3]).abs().max() < 1e-6
    heading = torch.atan2(-exact.T_cam_obj[:, 2, 0], exact.T_cam_obj[:, 0, 0])
    torch.testing.assert_close(
        heading, torch.atan2(-start.T_cam_obj[:, 2, 0], start.T_cam_obj[:, 0, 0]), rtol=0, atol=1e-6
    )
    # The shape still follows the images.
    assert exact.code.abs().max() > 0.05
    vague = _refined(replace(start, pose_sigma=torch.full((2, 4), math.inf, dtype=torch.float64)))
    torch.testing.assert_close(vague.T_cam_obj, _plain().T_cam_obj, rtol=0, atol=1e-9)


def test_a_certain_depth_holds_the_depth_alone() -> None:
    start = _start(torch.tensor([1e-5, math.inf, math.inf, math.inf], dtype=torch.float64).expand(2, 4))
    shift = (_refined(start).T_cam_obj - start.T_cam_obj)[:, :3, 3]
    ray = start.T_cam_obj[:, :3, 3] * torch.tensor([1.0, 0.0, 1.0], dtype=torch.float64)
    ray = ray / ray.norm(dim=1, keepdim=True)
    assert (shift * ray).sum(dim=1).abs().max() < 1e-5
    assert shift.abs().amax(dim=1).min() > 1e-3


@pytest.mark.parametrize("wrong", [0.0, -0.1, math.nan])
def test_standard_deviations_are_above_zero(wrong: float) -> None:
    sigma = SIGMA.repeat(2, 1)
    sigma[1, 2] = wrong
    message = r"pose_sigma: expected standard deviations above 0, got \[.*\] in row 1; give infinity for what"
    with pytest.raises(InputError, match=message):
        _start(sigma)
    with pytest.raises(InputError, match=r"pose_sigma"):
        _start(SIGMA)


@pytest.mark.parametrize(("mode", "iterations", "tolerance"), [("unroll", 2, 1e-4), ("implicit", 40, 2e-3)])
def test_the_anchor_follows_the_input_pose(mode: str, iterations: int, tolerance: float) -> None:
    inputs = StreetInputs()
    plain = replace(SETTLED, stages=(StageConfig(1.0, 0, iterations),))
    held = _with_sigmas(plain, across_m=0.1, along_share=0.03, yaw_deg=3.0)
    step = 1e-6 if mode == "unroll" else 1e-5  # what has converged has to a nanometre
    ends = [float(summary(inputs.refine(held, "pose", sign * step))) for sign in (1, -1)]
    numeric = (ends[0] - ends[1]) / (2 * step)
    assert abs(gradient_by(inputs, with_mode(mode, held), "pose") - numeric) < tolerance * abs(numeric)
    assert abs(numeric) > 0.05


def test_standard_deviations_carry_gradients() -> None:
    inputs = StreetInputs()
    few = replace(SETTLED, stages=(StageConfig(1.0, 0, 2),))

    def by_sigma(config: RefinerConfig, sigma: Tensor) -> Tensor:
        detections = replace(inputs.detections, mask_left=inputs.mask, pose_sigma=sigma)
        return summary(DirectShapeRefiner(inputs.prior, config)(inputs.scene.frames, detections))

    sigma = SIGMA.repeat(2, 1).requires_grad_()
    (gradient,) = torch.autograd.grad(by_sigma(with_mode("unroll", few), sigma), sigma)
    direction, step = torch.tensor([1.0, -0.7, 0.4, 1.3], dtype=torch.float64), 1e-6
    ends = [float(by_sigma(few, (sigma + sign * step * direction).detach())) for sign in (1, -1)]
    numeric = (ends[0] - ends[1]) / (2 * step)
    assert float((gradient * direction).sum()) == pytest.approx(numeric, rel=1e-5)
    assert gradient.abs().amax(dim=0).min() > 1e-3


def test_a_car_without_a_pose_is_left_alone_beside_one_with_gradients() -> None:
    inputs = StreetInputs()
    T_cam_obj = inputs.detections.T_cam_obj.clone()
    T_cam_obj[1] = torch.nan
    T_cam_obj.requires_grad_()
    detections = replace(inputs.detections, T_cam_obj=T_cam_obj)
    few = _with_sigmas(replace(SETTLED, stages=(StageConfig(1.0, 0, 2),)), along_share=0.02, yaw_deg=4.0)
    result = DirectShapeRefiner(inputs.prior, with_mode("unroll", few))(inputs.scene.frames, detections)
    assert result.refined.tolist() == [True, False]
    (gradient,) = torch.autograd.grad(result.T_cam_obj[0].sum(), T_cam_obj)
    assert gradient.isfinite().all()
    assert gradient[0].abs().max() > 0


def test_standard_deviations_of_the_settings_do_not_hold_boxes_that_no_detector_made() -> None:
    frames, detections = cached_street()[1].frames, replace(_start(), is_from_masks=torch.tensor([True, False]))
    of_settings = _with_sigmas(along_m=0.3, across_m=0.1).priors
    sigma = detector_pose_sigma(of_settings, CarBatch.from_scene(frames, detections))
    assert sigma.tolist() == [[math.inf] * 4, [pytest.approx(0.3), pytest.approx(0.1), math.inf, math.inf]]
    given = replace(detections, pose_sigma=SIGMA.expand(2, 4).to(detections.T_cam_obj))
    assert detector_pose_sigma(of_settings, CarBatch.from_scene(frames, given)).equal(given.pose_sigma)
