"""The trace agrees with the refiner in ends and costs, and has complete states."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers.quick_runs import IMAGES_ALONE

from directshape_torch.cli.demo import demo_dataset
from directshape_torch.geometry import se3
from directshape_torch.io.config_files import load_config
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.scene.detections import Detections
from directshape_torch.visualize.refinement_trace import RefinementTrace, trace_refinement


@pytest.fixture(scope="module")
def demo_frame() -> LoadedFrame:
    data = demo_dataset()
    return data.load(data.frame_ids[0])


def _with_lost_car(detections: Detections) -> Detections:
    """The detections with a first car without a pose, which takes no part."""
    T_cam_obj = detections.T_cam_obj.clone()
    T_cam_obj[0, :3, 3] = torch.nan
    return replace(detections, T_cam_obj=T_cam_obj)


@pytest.fixture(scope="module", params=["fast", "geometric"])
def trace(request: pytest.FixtureRequest, demo_frame: LoadedFrame) -> RefinementTrace:
    refiner = DirectShapeRefiner(config=load_config(request.param, [*IMAGES_ALONE]))
    return trace_refinement(refiner, demo_frame.frame, _with_lost_car(demo_frame.detections))


def test_ends_of_the_trace_are_input_and_result(trace: RefinementTrace, demo_frame: LoadedFrame) -> None:
    refined = trace.result.refined
    assert refined[1:].any()
    assert torch.equal(trace.T_cam_obj[-1][refined], trace.result.T_cam_obj[refined])
    assert torch.equal(trace.codes[-1][refined], trace.result.code[refined])
    expected = se3.inverse(demo_frame.detections.T_cam_obj)
    assert torch.equal(trace.states[0].T_obj_cam[1:], expected[1:])


def test_costs_at_the_ends_are_those_of_the_result(trace: RefinementTrace) -> None:
    result, refined = trace.result, trace.result.refined
    torch.testing.assert_close(trace.costs[0], result.cost_before, rtol=0, atol=0, equal_nan=True)
    torch.testing.assert_close(trace.costs[-1][refined], result.cost_after[refined], rtol=2e-4, atol=1e-6)


def test_a_refinement_without_images_has_no_residuals_of_them(trace: RefinementTrace) -> None:
    counts = [len(pixels.uv) for pixels in trace.residuals(0)[1]]
    assert min(counts) > 0 if trace.config.fits_images else counts == [0, 0, 0]


def test_car_without_pose_takes_no_part(trace: RefinementTrace) -> None:
    assert trace.place_of(0) == -1
    assert trace.place_of(1) == 0
    assert not trace.accepted[:, 0].any()
    assert trace.costs[:, 0].isnan().all()


def test_cars_move_where_a_step_was_accepted_and_nowhere_else(trace: RefinementTrace) -> None:
    for car in trace.rows.tolist():
        for k in range(1, len(trace)):
            same = all(torch.equal(a[car], b[car]) for a, b in zip(trace.states[k], trace.states[k - 1], strict=True))
            assert same or trace.accepted[k, car]
        assert trace.steps_of(car)[0] == 0
        assert trace.steps_of(car)[-1] == len(trace) - 1


def test_no_cars_at_all(demo_frame: LoadedFrame) -> None:
    T_cam_obj = torch.full_like(demo_frame.detections.T_cam_obj, torch.nan)
    T_cam_obj[:, :3, :3] = torch.eye(3)
    refiner = DirectShapeRefiner(config=load_config("fast"))
    trace = trace_refinement(refiner, demo_frame.frame, replace(demo_frame.detections, T_cam_obj=T_cam_obj))
    assert len(trace) == len(trace.costs) == 1
    assert len(trace.rows) == 0
