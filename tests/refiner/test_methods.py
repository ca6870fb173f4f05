"""These tests run whole refinements by point cloud, alone and with the images."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import pytest
import torch
from helpers.problems import DEFAULT, GEOMETRIC
from helpers.synthetic_scene import disturbed, joined_detections, joined_frames, masked, measured_street, select
from torch import Tensor

from directshape_torch.config import PointCloudConfig, RefinerConfig, StageConfig
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import FrameBatch
from directshape_torch.status import Status

WEAK = replace(DEFAULT.priors, shape_weight=0.01, dimensions_weight=0.0)
CLOUD = PointCloudConfig(weight=1000.0, min_points=50)
ROUND = GEOMETRIC.stages[:2]
ALTERNATING = replace(GEOMETRIC, point_cloud=CLOUD, priors=WEAK, stages=12 * ROUND)
JOINT = replace(ALTERNATING, stages=(StageConfig(max_iterations=60),))
COMBINED = replace(DEFAULT, point_cloud=CLOUD)
CONFIGS = {"alternating": ALTERNATING, "joint": JOINT, "combined": COMBINED}


def scene_of(frames: FrameBatch | None = None) -> tuple[FrameBatch, Detections]:
    scene = measured_street()[1]
    return frames or scene.frames, disturbed(scene.detections, 0.25, 0.08)


def refine(config: RefinerConfig, frames: FrameBatch, detections: Detections) -> RefinementResult:
    return DirectShapeRefiner(measured_street()[0], config)(frames, detections)


@cache
def refined(method: str) -> RefinementResult:
    """The result for the scene with these settings, which must not be changed."""
    return refine(CONFIGS[method], *scene_of())


def centre_errors(T_cam_obj: Tensor) -> Tensor:
    truth = measured_street()[1].detections.T_cam_obj
    return (T_cam_obj - truth)[:, :3, 3].norm(dim=1)


@pytest.mark.parametrize("method", CONFIGS)
def test_exact_points_lead_to_the_truth(method: str) -> None:
    detections, result = scene_of()[1], refined(method)
    assert all(status.is_refined for status in result.status)
    assert (centre_errors(result.T_cam_obj) < 0.4 * centre_errors(detections.T_cam_obj)).all()
    assert (result.cost_after.sum(1) < 0.3 * result.cost_before.sum(1)).all()
    cloud = result.term_names.index("point_cloud")
    assert (result.cost_after[:, cloud] < 0.03 * result.cost_before[:, cloud]).all()
    assert result.covariance_xyz_yaw.isfinite().all()
    assert result.quality.mask_iou_left.min() > 0.85
    assert (result.quality.photometric_error_grey.isnan() == (method != "combined")).all()


@pytest.mark.parametrize("method", ["alternating", "combined"])
def test_a_batch_equals_a_loop_and_order_does_not_matter(method: str) -> None:
    config, (frames, detections) = CONFIGS[method], scene_of()
    both = joined_frames([frames, frames])
    other = disturbed(detections, 0.1, 0.03, seed=8)
    together = refine(config, both, joined_detections([detections, other], (120, 160)))
    for alone, rows in ((refined(method), slice(0, 2)), (refine(config, frames, other), slice(2, 4))):
        torch.testing.assert_close(together.T_cam_obj[rows], alone.T_cam_obj, rtol=0, atol=1e-9)
        torch.testing.assert_close(together.code[rows], alone.code, rtol=0, atol=1e-9)
    swapped = refine(config, frames, select(detections, torch.tensor([1, 0])))
    torch.testing.assert_close(swapped.T_cam_obj.flip(0), together.T_cam_obj[:2], rtol=0, atol=1e-9)


def _hide(frames: FrameBatch, mask: Tensor, left_over: int) -> FrameBatch:
    """The frames without disparity inside a mask (H, W), except for some pixels."""
    assert frames.disparity is not None
    pixels = (mask > 0.5).nonzero()[left_over:]
    disparity = frames.disparity.clone()
    disparity[0, pixels[:, 0], pixels[:, 1]] = torch.nan
    return replace(frames, disparity=disparity)


def test_too_few_points_are_a_status_and_touch_no_other_car() -> None:
    frames, detections = scene_of()
    healthy = refined("alternating")
    result = refine(ALTERNATING, _hide(frames, detections.mask_left[1], CLOUD.min_points - 1), detections)
    assert result.status[1] is Status.too_few_points
    assert "point_cloud.min_points" in result.status[1].value
    assert torch.equal(result.T_cam_obj[1], detections.T_cam_obj[1])
    assert result.cost_before[1].isnan().all()
    torch.testing.assert_close(result.T_cam_obj[0], healthy.T_cam_obj[0], rtol=0, atol=1e-9)
    assert result.status[0] is healthy.status[0]


def test_combined_without_points_is_direct() -> None:
    frames, detections = scene_of()
    nothing = _hide(_hide(frames, detections.mask_left[0], 0), detections.mask_left[1], 0)
    combined, direct = refine(COMBINED, nothing, detections), refine(DEFAULT, frames, detections)
    assert combined.status == direct.status
    torch.testing.assert_close(combined.T_cam_obj, direct.T_cam_obj, rtol=0, atol=1e-9)
    assert (combined.cost_after[:, combined.term_names.index("point_cloud")] == 0).all()


def test_no_mask_is_no_obstacle_for_the_point_cloud() -> None:
    frames, detections = scene_of()
    absent = torch.zeros_like(detections.has_mask_left)
    bare = masked(detections, absent, absent)
    assert all(status.is_refined for status in refine(ALTERNATING, frames, bare).status)
    assert refine(COMBINED, frames, bare).status == [Status.no_mask] * 2


def test_without_a_map_the_images_are_matched() -> None:
    scene = measured_street()[1]
    detections = disturbed(scene.detections, 0.25, 0.08)
    result = refine(ALTERNATING, replace(scene.frames, disparity=None), detections)
    assert all(status.is_refined for status in result.status)
    # Of the near car: at 12.5 m the disparity is 6 px here, and a tenth of a pixel is 0.2 m.
    assert centre_errors(result.T_cam_obj)[0] < 0.5 * centre_errors(detections.T_cam_obj)[0]


@pytest.mark.parametrize("mode", ["implicit", "unroll"])
def test_gradients_reach_the_disparity(mode: Any) -> None:
    """A wider disparity brings the car nearer: the derivative of depth by all disparities is `-z^2 / (f b)`."""
    frames, detections = scene_of()
    exact = replace(DEFAULT.solver, cost_tolerance=1e-14, step_tolerance=1e-10)
    backward = replace(DEFAULT.backward, mode=mode, unroll_iterations=30)
    config = replace(JOINT, backward=backward, solver=exact)
    assert frames.disparity is not None
    shift = torch.zeros((), dtype=torch.float64, requires_grad=True)
    result = refine(config, replace(frames, disparity=frames.disparity + shift), detections)
    depth = result.T_cam_obj[0, 2, 3]
    (slope,) = torch.autograd.grad(depth, shift)
    steps = [
        refine(JOINT, replace(frames, disparity=frames.disparity + s), detections).T_cam_obj[0, 2, 3]
        for s in (0.02, -0.02)
    ]
    assert float(slope) < -0.3
    assert float(slope) == pytest.approx(float(steps[0] - steps[1]) / 0.04, rel=0.15)
