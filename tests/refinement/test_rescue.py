"""Cars with wrong boxes are found from their masks or refused, and other cars are left alone."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import pytest
import torch
from torch import Tensor

from directshape_torch import Detections, DirectShapeRefiner, FrameBatch, RefinementResult, load_config
from directshape_torch.geometry.box3d import rotation_about_y, rotation_y_from_pose
from directshape_torch.laboratory.scenes import LaboratoryScene, load_scene
from directshape_torch.refinement import lost_cars
from directshape_torch.status import Status

load_scene = cache(load_scene)


def refined(frame: FrameBatch, detections: Detections, *settings: str) -> RefinementResult:
    config = load_config("default", ["check=off", *settings])
    result: RefinementResult = DirectShapeRefiner(config=config).to(frame.images_left.dtype)(frame, detections)
    return result


@cache
def as_given() -> RefinementResult:
    return refined(load_scene().frame, load_scene().detections, "search=off")


def turned(T_cam_obj: Tensor) -> Tensor:
    """The poses with cars turned by 90 degrees about their own upright axis."""
    T = T_cam_obj.clone()
    T[:, :3, :3] = T[:, :3, :3] @ rotation_about_y(T.new_tensor(math.pi / 2))
    return T


def nearer(T_cam_obj: Tensor) -> Tensor:
    """The poses with cars 3 m nearer along their viewing rays on the ground."""
    T = T_cam_obj.clone()
    T[:, 0:3:2, 3] *= 1 - 3.0 / T[:, 0:3:2, 3].norm(dim=1, keepdim=True)
    return T


def cars(scene: LaboratoryScene, *rows: int) -> Detections:
    return scene.detections.rows(torch.tensor(rows))


def distance_from_given(found: RefinementResult, row: int) -> tuple[float, float]:
    """Metres and degrees, modulo half a turn, from the car that the boxes as they are lead to."""
    truth = as_given()
    metres = (found.T_cam_obj[row, :3, 3] - truth.T_cam_obj[row, :3, 3]).norm()
    angle = rotation_y_from_pose(found.T_cam_obj[row]) - rotation_y_from_pose(truth.T_cam_obj[row])
    return float(metres), math.degrees(float(torch.asin(torch.sin(angle).abs())))


@pytest.mark.parametrize(("change", "found_rows"), [(turned, (0, 1, 2, 4, 5)), (nearer, (0, 1, 2))])
def test_cars_whose_boxes_are_far_off_are_found_and_others_stay_to_the_bit(
    change: object, found_rows: tuple[int, ...]
) -> None:
    scene = load_scene()
    assert callable(change)
    wrong = replace(scene.detections, T_cam_obj=change(scene.detections.T_cam_obj))
    result, before = refined(scene.frame, wrong), refined(scene.frame, wrong, "search=off")
    for row in found_rows:
        assert result.status[row] is Status.rescued
        metres, degrees = distance_from_given(result, row)
        assert metres < 0.6
        assert degrees < 10
    assert torch.equal(result.input_dimensions_hwl, before.input_dimensions_hwl)
    others = [row for row, status in enumerate(result.status) if status is not Status.rescued]
    assert result.iterations[list(found_rows)].gt(before.iterations[list(found_rows)]).all()
    for name, value in before[others].state_dict().items():
        same = result[others].state_dict()[name]
        same = same[:, : value.shape[1]] if name == "cost_history" else same
        assert torch.equal(same.nan_to_num(nan=-1.0), value.nan_to_num(nan=-1.0)), name


def test_a_gross_error_is_not_weighed_and_says_how_far_off_it_is() -> None:
    scene = load_scene()
    given = cars(scene, 1)
    result = refined(scene.frame, replace(given, T_cam_obj=turned(given.T_cam_obj)))
    assert result.status == [Status.rescued]
    assert not result.comparison.gain.any()
    assert float(result.comparison.distance_in_sigmas[0]) > 6


def test_cars_that_are_not_lost_cost_no_disparity(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError

    monkeypatch.setattr(lost_cars, "with_disparity", refuse)
    scene = load_scene()
    assert refined(scene.frame, cars(scene, 1, 2)).refined.all()
    with pytest.raises(AssertionError):
        refined(scene.frame, cars(scene, 1, 2), "search=always")


def test_views_of_tracks_and_boxes_made_of_masks_are_left_alone() -> None:
    scene = load_scene()
    given = replace(cars(scene, 1), T_cam_obj=turned(cars(scene, 1).T_cam_obj))
    in_track = replace(given, track_id=torch.tensor([7]))
    made = replace(given, is_from_masks=torch.tensor([True]))
    for left_alone in (in_track, made):
        assert Status.rescued not in refined(scene.frame, left_alone).status


def test_a_car_by_itself_is_found_beside_views_of_a_track() -> None:
    scene = load_scene()
    frames = FrameBatch.joined([scene.frame, scene.frame])
    given = cars(scene, 0, 0, 1)
    T_cam_obj = torch.cat([given.T_cam_obj[:2], turned(given.T_cam_obj[2:])])
    mixed = replace(given, T_cam_obj=T_cam_obj, frame_index=torch.tensor([0, 1, 0]), track_id=torch.tensor([7, 7, -1]))
    result, alone = refined(frames, mixed), refined(frames, mixed.rows(torch.tensor([2])))
    assert result.status[2] is alone.status[0] is Status.rescued
    assert result.track_part.tolist() == [0, 0, -1]
    only_of_tracks = [name not in alone.term_names for name in result.term_names]
    assert any(only_of_tracks)
    assert not result.cost_after[2, only_of_tracks].any()


def test_gradients_hold_for_the_start_that_was_chosen() -> None:
    scene = load_scene()
    given = replace(cars(scene, 1), T_cam_obj=turned(cars(scene, 1).T_cam_obj).requires_grad_())
    frame = replace(scene.frame, images_right=scene.frame.images_right.clone().requires_grad_())
    result = refined(frame, given, "backward.mode=unroll")
    assert result.status == [Status.rescued]
    result.T_cam_obj[:, :3, 3].sum().backward()
    assert frame.images_right.grad is not None
    assert frame.images_right.grad.abs().sum() > 0
    assert given.T_cam_obj.grad is None or not given.T_cam_obj.grad.any()


EVERY = "acceptance.min_probability_better=0", "acceptance.min_probability_not_worse=0"


def refined_from(factor: float, dimensions: float, *settings: str) -> RefinementResult:
    """The result of three cars whose places and sizes are wrong by factors, without a search for them."""
    scene = load_scene()
    T_cam_obj = cars(scene, 0, 1, 3).T_cam_obj.clone()
    T_cam_obj[:, :3, 3] *= factor
    moved = replace(cars(scene, 0, 1, 3), T_cam_obj=T_cam_obj)
    moved = replace(moved, dimensions_hwl=moved.dimensions_hwl * dimensions)
    result = refined(scene.frame, moved, "search=off", *settings)
    assert result.sigma_xyz_yaw[result.refined].isfinite().all()
    return result


@pytest.mark.parametrize("dimensions", [1.0, 200.0])
def test_boxes_beyond_two_kilometres_have_no_evidence_whatever_is_accepted(dimensions: float) -> None:
    result = refined_from(200.0, dimensions, *EVERY)
    assert (result.T_cam_obj[:, 2, 3] > 2000).all()
    assert set(result.status) <= {Status.mask_missed, Status.no_match, Status.depth_unknown}
    assert result.quality.probability_not_worse.isnan().all()


@pytest.mark.parametrize(("factor", "dimensions"), [(2.0, 1.0), (2.0, 2.0), (0.5, 1.0), (0.5, 0.5)])
def test_a_wrong_depth_has_no_evidence(factor: float, dimensions: float) -> None:
    """Cars of twice the size at twice the depth cover their masks, too."""
    wrong = refined_from(factor, dimensions)
    assert not wrong.refined.any(), wrong.status


def test_boxes_as_they_are_come_back_refined() -> None:
    assert refined_from(1.0, 1.0, *EVERY).refined.all()


def test_boxes_and_masks_of_another_image_show_no_car() -> None:
    """The images are moved along themselves, so that streets and walls lie under the masks of six cars."""
    scene = load_scene()
    for shift_px in (150, 330, 520):
        images = {side: getattr(scene.frame, side).roll(shift_px, dims=3) for side in ("images_left", "images_right")}
        result = refined(replace(scene.frame, **images), scene.detections)
        assert int(result.refined.sum()) <= 1
        assert Status.rescued not in result.status


def test_masks_of_other_cars_are_refused_by_name() -> None:
    given, others = load_scene().detections, torch.arange(6).roll(1)
    swapped = replace(given, mask_left=given.mask_left.rows(others), mask_right=given.mask_right.rows(others))
    result = refined(load_scene().frame, swapped)
    assert set(result.status) <= {Status.mask_missed, Status.no_match, Status.no_car, Status.rejected_worse}
