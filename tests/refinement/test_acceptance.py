"""For results that are not trusted the input is returned with its gradient, and other cars are unchanged."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import pytest
import torch
from helpers.problems import DEFAULT
from helpers.synthetic_scene import cached_street, disturbed

from directshape_torch.config import AcceptanceConfig, BackwardConfig, RefinerConfig, RigConfig
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.scene.detections import Detections
from directshape_torch.status import Status


def accepting(min_probability: float, config: RefinerConfig = DEFAULT) -> RefinerConfig:
    return replace(config, acceptance=AcceptanceConfig(0.0, min_probability))


def refine(config: RefinerConfig, detections: Detections) -> RefinementResult:
    prior, scene = cached_street()
    result: RefinementResult = DirectShapeRefiner(prior, config)(scene.frames, detections)
    return result


@cache
def trusting() -> tuple[Detections, RefinementResult]:
    _, scene = cached_street()
    detections = disturbed(scene.detections)
    return detections, refine(accepting(0.0), detections)


def test_a_threshold_between_two_cars_returns_the_input_of_one() -> None:
    detections, before = trusting()
    probability = before.quality.probability_not_worse
    less, more = probability.argsort().tolist()
    assert before.refined.all()
    assert 0 < probability[less] < probability[more] < 1
    result = refine(accepting(float(probability.mean())), detections)
    assert result.status[less] is Status.not_trusted
    assert result.status[more] is before.status[more]
    assert result.refined.tolist() == [i == more for i in range(2)]
    assert torch.equal(result.T_cam_obj[less], detections.T_cam_obj[less])
    assert torch.equal(result.boxes().dimensions_hwl[less], detections.dimensions_hwl[less])
    assert torch.equal(result.T_cam_obj[more], before.T_cam_obj[more])
    assert (result.code[less] == 0).all()
    # Why it is not trusted can be read off.
    assert torch.equal(result.quality.probability_not_worse, probability)
    assert result.sigma_xyz_yaw[less].isnan().all()
    assert "`acceptance`" in result.status[less].value


def test_either_probability_refuses() -> None:
    detections, before = trusting()
    limit = float(before.quality.probability_better.mean())
    result = refine(replace(DEFAULT, acceptance=AcceptanceConfig(limit, 0.0)), detections)
    assert (
        result.refined.tolist()
        == (before.quality.probability_better >= limit).tolist()
        in ([True, False], [False, True])
    )


@pytest.mark.parametrize("mode", ["unroll", "implicit"])
def test_gradients_pass_where_results_do_not(mode: str) -> None:
    """A car that is not trusted passes its input through, with the gradient 1."""
    detections, before = trusting()
    probability = before.quality.probability_not_worse
    less = int(probability.argmin())
    config = replace(accepting(float(probability.mean())), backward=BackwardConfig(mode=mode, max_remaining_step=10.0))
    T = detections.T_cam_obj.clone().requires_grad_()
    weight = torch.ones(2, dtype=torch.float64, requires_grad=True)
    prior, scene = cached_street()
    refiner = DirectShapeRefiner(prior, config)
    result = refiner(scene.frames, replace(detections, T_cam_obj=T), {"silhouette_left": weight})
    gradient, by_weight = torch.autograd.grad(result.T_cam_obj[:, :3, 3].sum(), (T, weight))
    expected = torch.zeros(4, 4, dtype=torch.float64)
    expected[:3, 3] = 1
    torch.testing.assert_close(gradient[less], expected)
    assert gradient.isfinite().all()
    assert by_weight.isfinite().all()
    assert by_weight[less] == 0
    assert by_weight[1 - less] != 0


def test_other_terms_give_no_probability_and_are_not_refused() -> None:
    prior, scene = cached_street()
    blind = replace(DEFAULT, photometric=replace(DEFAULT.photometric, weight=0.0))
    result = DirectShapeRefiner(prior, accepting(1.0, blind))(scene.frames, scene.detections)
    assert result.quality.probability_better.isnan().all()
    assert Status.not_trusted not in result.status


def test_a_rig_that_may_be_off_is_trusted_less() -> None:
    detections, sure = trusting()
    doubtful = refine(replace(accepting(0.0), rig=RigConfig(disparity_sigma_px=0.4)), detections)
    assert (doubtful.quality.probability_better < sure.quality.probability_better).all()
    assert (doubtful.sigma_xyz_yaw[:, 2] > sure.sigma_xyz_yaw[:, 2]).all()


@pytest.mark.parametrize("wrong", ["millimetres", "beside the mask"])
def test_a_shape_that_misses_its_mask_is_not_returned_whatever_is_accepted(wrong: str) -> None:
    _, scene = cached_street()
    T_cam_obj = disturbed(scene.detections).T_cam_obj.clone()
    if wrong == "millimetres":
        T_cam_obj[0, :3, 3] *= 1000
    else:
        T_cam_obj[0, 0, 3] += 4
    detections = replace(disturbed(scene.detections), T_cam_obj=T_cam_obj)
    result = refine(accepting(0.0), detections)
    assert result.status[0] is Status.mask_missed
    assert result.quality.mask_iou_left[0] < 0.3
    assert torch.equal(result.T_cam_obj[0], T_cam_obj[0])
    assert result.quality.probability_not_worse[0].isnan()
    assert result.status[1].is_refined


def test_a_car_with_nothing_left_to_gain_has_converged_when_its_iterations_run_out() -> None:
    _, scene = cached_street()
    never_settles = replace(DEFAULT.solver, cost_tolerance=1e-12, step_tolerance=1e-12)
    stages = [tuple(replace(stage, max_iterations=n) for stage in DEFAULT.stages) for n in (1, 12)]
    few, many = (
        refine(replace(accepting(0.0), solver=never_settles, stages=one), disturbed(scene.detections)) for one in stages
    )
    assert few.status[1] is Status.max_iterations
    assert many.status == [Status.converged] * 2
