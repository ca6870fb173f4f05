"""The result of the best of several poses of a car is kept, whoever else is refined and in whatever order."""

from __future__ import annotations

import math
from dataclasses import replace
from operator import attrgetter
from pathlib import Path

import pytest
import torch
from helpers.street_inputs import SETTLED, StreetInputs, summary, with_mode
from torch import Tensor

import directshape_torch
from directshape_torch import Detections, DirectShapeRefiner, load_config
from directshape_torch.geometry.box3d import rotation_y_from_pose
from directshape_torch.geometry.se3 import exp
from directshape_torch.io.frame_collation import collate
from directshape_torch.io.stereo_dataset import LoadedFrame, open_dataset
from directshape_torch.refinement.candidates import probability_of_sense
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.scene.frames import FrameBatch
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.state.cars import CarBatch
from directshape_torch.terms.priors import PriorTerm

DEMO = Path(directshape_torch.__file__).parent / "assets" / "demo"


@pytest.fixture(scope="module")
def demo() -> LoadedFrame:
    """The bundled frame with its true boxes."""
    return open_dataset("kitti", DEMO, DEMO / "training" / "label_2", DEMO / "training" / "masks").load("000000")


def refined(demo: LoadedFrame, detections: Detections, *settings: str) -> RefinementResult:
    config = load_config(None, ["check=off", *settings])
    with torch.no_grad():
        return DirectShapeRefiner(config=config)(demo.frame, detections)


def turned(T_cam_obj: Tensor, degrees: float) -> Tensor:
    """Poses of cars that are turned about their own vertical axis."""
    step = T_cam_obj.new_tensor([0, 0, 0, 0, math.radians(degrees), 0])
    return T_cam_obj @ exp(step[None])


def with_others(detections: Detections, *others: Tensor) -> Detections:
    return replace(detections, other_T_cam_obj=torch.stack(others, dim=1))


def heading_error_deg(result: RefinementResult, truth: Detections) -> Tensor:
    off = rotation_y_from_pose(result.T_cam_obj) - rotation_y_from_pose(truth.T_cam_obj)
    return torch.rad2deg(torch.atan2(torch.sin(off), torch.cos(off)).abs())


def assert_equal(found: RefinementResult, expected: RefinementResult, rtol: float = 0, atol: float = 0) -> None:
    """Equal results, but for columns of iterations in which no car of them took part."""
    expected_state = expected.state_dict()
    for name, tensor in found.state_dict().items():
        if name != "cost_history":
            torch.testing.assert_close(tensor, expected_state[name], rtol=rtol, atol=atol, equal_nan=True)


@pytest.fixture(scope="module")
def cars(demo: LoadedFrame) -> Detections:
    """The three largest cars of the frame, which start at their true boxes."""
    return demo.detections.rows(demo.detections.mask_left.areas.argsort(descending=True)[:3])


def test_the_true_pose_is_found_among_wrong_ones(demo: LoadedFrame, cars: Detections) -> None:
    T = cars.T_cam_obj
    wrong = replace(cars, T_cam_obj=turned(T, 90))
    found = refined(demo, with_others(wrong, turned(T, -90), T), "priors.detector_weight=0")
    assert found.refined.all()
    assert (heading_error_deg(found, cars) < 5).all()
    alone = refined(demo, wrong, "priors.detector_weight=0")
    assert (heading_error_deg(alone, cars) > 20).any()


def test_the_front_is_found_and_more_probable_than_the_back(demo: LoadedFrame, cars: Detections) -> None:
    backwards = replace(cars, T_cam_obj=turned(cars.T_cam_obj, 180))
    found = refined(demo, with_others(backwards, cars.T_cam_obj))
    assert (heading_error_deg(found, cars) < 5).all()
    assert (found.quality.probability_heading > 0.7).all()


def test_the_order_of_poses_does_not_matter(demo: LoadedFrame, cars: Detections) -> None:
    T = cars.T_cam_obj
    others = turned(T, 180), turned(T, 90), turned(T, 30)
    first, second = (refined(demo, with_others(cars, *some)) for some in (others, others[::-1]))
    assert_equal(second, first)


def test_a_batch_equals_a_loop_and_poses_of_one_car_change_no_other(demo: LoadedFrame, cars: Detections) -> None:
    T = cars.T_cam_obj.clone()
    opposite = turned(T, 180)
    opposite[1] = torch.nan
    both = replace(cars, T_cam_obj=turned(T, 180), other_T_cam_obj=torch.stack([T, opposite], dim=1))
    together = refined(demo, both)
    for row in range(3):
        alone = refined(demo, both.rows(torch.tensor([row])))
        torch.testing.assert_close(together[row].T_cam_obj, alone.T_cam_obj, rtol=0, atol=1e-3)
        torch.testing.assert_close(
            together[row].quality.probability_heading, alone.quality.probability_heading, rtol=0, atol=0.01
        )
    without = with_others(both, torch.full_like(T, torch.nan))
    without.other_T_cam_obj[0, 0] = T[0]
    plain, found = refined(demo, replace(both, other_T_cam_obj=None)), refined(demo, without)
    # How many cars a call has decides in which order matrix products add, and with it the last bit.
    assert_equal(found[1:], plain[1:], rtol=0.01, atol=1e-4)
    assert heading_error_deg(found, cars)[0] < 5 < heading_error_deg(plain, cars)[0]
    assert found.quality.probability_heading.isnan().tolist() == [False, True, True]


def test_terms_are_made_once_and_of_the_boxes_that_were_given(demo: LoadedFrame, cars: Detections) -> None:
    """The prior of the pose compares with the given box, wherever a candidate begins."""
    far = cars.T_cam_obj.clone()
    far[:, 2, 3] += 2.0
    made: list[CarBatch] = []

    def nothing(_frames: FrameBatch, _detections: Detections, cars: CarBatch, _prior: ShapePrior) -> PriorTerm:
        made.append(cars)
        return PriorTerm("nothing", 1.0, cars, lambda _, state: 0.0 * state.code[:, :1], 1, ("code",))

    refiner = DirectShapeRefiner(config=load_config(None, ["check=off"]), extra_terms=[nothing])
    with torch.no_grad():
        refiner(demo.frame, with_others(cars, far))
    (given,) = made
    assert given.detection_row.tolist() == [0, 1, 2, 0, 1, 2]
    assert torch.equal(given.detector_T_cam_obj, torch.cat([cars.T_cam_obj, cars.T_cam_obj]))


def test_poses_behind_the_camera_and_missing_ones_are_no_candidates(demo: LoadedFrame, cars: Detections) -> None:
    behind = cars.T_cam_obj.clone()
    behind[:, 2, 3] *= -1
    found = refined(demo, with_others(cars, behind, torch.full_like(behind, torch.nan)))
    assert_equal(found, refined(demo, cars))


def test_the_box_of_the_chosen_pose_is_compared_and_combined(demo: LoadedFrame, cars: Detections) -> None:
    far = cars.T_cam_obj.clone()
    far[:, [0, 2], 3] *= 1.3
    found, alone = refined(demo, with_others(replace(cars, T_cam_obj=far), cars.T_cam_obj)), refined(demo, cars)
    torch.testing.assert_close(found.comparison.difference, alone.comparison.difference, rtol=0, atol=0.1)
    torch.testing.assert_close(found.T_cam_obj, alone.T_cam_obj, rtol=0, atol=0.1)


def test_cars_outside_of_tracks_choose_as_in_a_call_without_tracks(demo: LoadedFrame, cars: Detections) -> None:
    several = with_others(cars, turned(cars.T_cam_obj, 180))
    by_itself = replace(several, track_id=torch.tensor([-1, -1, -1]))
    found, expected = refined(demo, by_itself), refined(demo, several)
    # Both poses of a car are refined in one batch in one call, and one after the other in the other.
    for name in ("T_cam_obj", "code", "status_code", "covariance", "quality.probability_heading"):
        (of_found, of_expected) = (attrgetter(name)(result) for result in (found, expected))
        torch.testing.assert_close(of_found, of_expected, rtol=0.01, atol=1e-4, equal_nan=True)


@pytest.mark.parametrize("mode", ["unroll", "implicit"])
def test_gradients_are_those_of_the_chosen_pose(mode: str) -> None:
    inputs = StreetInputs()
    detections = replace(inputs.detections, mask_left=inputs.mask)
    config = with_mode(mode, replace(SETTLED, stages=SETTLED.stages[1:]))

    def gradients(far: Tensor | None) -> tuple[Tensor, Tensor | None]:
        T = detections.T_cam_obj.clone().requires_grad_()
        mask = inputs.mask.clone().requires_grad_()
        given = replace(detections, T_cam_obj=T, mask_left=mask)
        if far is not None:
            given = replace(given, T_cam_obj=far, other_T_cam_obj=T[:, None])
        result = DirectShapeRefiner(inputs.prior, config)(inputs.scene.frames, given)
        return torch.autograd.grad(summary(result), [mask, T], allow_unused=True)

    beside = detections.T_cam_obj.clone()
    beside[:, 0, 3] += 8.0
    (by_mask, by_pose), (expected_by_mask, expected_by_pose) = gradients(beside), gradients(None)
    torch.testing.assert_close(by_mask, expected_by_mask, rtol=1e-5, atol=1e-7)
    if mode == "unroll":
        # The depth of the first pose alone enters the contour width.
        by_pose[:, 2, 3] = expected_by_pose[:, 2, 3]
        torch.testing.assert_close(by_pose, expected_by_pose, rtol=1e-5, atol=1e-6)


def test_who_costs_as_much_in_both_senses_has_an_even_chance() -> None:
    forward = torch.tensor([[[1.0, 0, 0], [-1.0, 0, 0], [0, 0, 1.0]]]).expand(3, 3, 3)
    cost = torch.tensor([[5.0, 5.0, 9.0], [5.0, 6.0, 5.5], [7.0, 6.0, torch.inf]], dtype=torch.float64)
    even, likely, unlikely = probability_of_sense(cost, forward, torch.zeros(3, dtype=torch.long)).tolist()
    assert even == 0.5
    assert 0.9 < likely < 1
    assert unlikely == pytest.approx(1 - likely)
    assert probability_of_sense(cost[:1], forward[:1], torch.tensor([2])).isnan().all()


def test_views_of_a_track_agree_on_the_front(demo: LoadedFrame, cars: Detections) -> None:
    """The second view is the same frame again, and its start faces the other way."""
    frames, twice = collate([replace(demo, detections=cars), replace(demo, detections=cars)])
    count = len(cars)
    start = twice.T_cam_obj.clone()
    start[count:] = turned(start[count:], 180)
    views = replace(twice, T_cam_obj=start, track_id=torch.arange(count).repeat(2))
    config = load_config(None, ["check=off"])
    with torch.no_grad():
        found = DirectShapeRefiner(config=config)(frames, with_others(views, turned(start, 180)))
    assert found.refined.all()
    assert (heading_error_deg(found, twice) < 5).all()
    assert torch.equal(found.code[:count], found.code[count:])
    assert torch.equal(found.quality.probability_heading[:count], found.quality.probability_heading[count:])
    assert (found.quality.probability_heading > 0.7).all()
