"""Boxes of the bundled frame that are wrong by factors are recognised, with masks that are right."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from directshape_torch import DirectShapeRefiner, RefinementResult, load_config
from directshape_torch.laboratory.scenes import load_scene, select_detections
from directshape_torch.status import Status


def refined(factor: float, dimensions: float, *settings: str) -> RefinementResult:
    scene = load_scene()
    first = select_detections(scene.detections, scene.detections.frame_index.new_tensor([0, 1, 3]))
    T_cam_obj = first.T_cam_obj.clone()
    T_cam_obj[:, :3, 3] *= factor
    moved = replace(first, T_cam_obj=T_cam_obj, dimensions_hwl=first.dimensions_hwl * dimensions)
    # The default finds these cars from their masks.
    config = load_config("default", ["search=off", *settings])
    result: RefinementResult = DirectShapeRefiner(config=config).to(T_cam_obj.dtype)(scene.frame, moved)
    assert result.sigma_xyz_yaw[result.refined].isfinite().all()
    return result


@pytest.mark.parametrize("dimensions", [1.0, 200.0])
def test_boxes_beyond_two_kilometres_have_no_evidence_whatever_is_accepted(dimensions: float) -> None:
    every = "acceptance.min_probability_better=0", "acceptance.min_probability_not_worse=0"
    result = refined(200.0, dimensions, *every)
    assert (result.T_cam_obj[:, 2, 3] > 2000).all()
    assert set(result.status) <= {Status.mask_missed, Status.no_match, Status.depth_unknown}
    assert result.quality.probability_not_worse.isnan().all()


@pytest.mark.parametrize(("factor", "dimensions"), [(2.0, 1.0), (2.0, 2.0), (0.5, 1.0), (0.5, 0.5)])
def test_a_wrong_depth_has_no_evidence(factor: float, dimensions: float) -> None:
    """Of twice the size at twice the depth, so that they cover their masks, too."""
    wrong = refined(factor, dimensions)
    assert not wrong.refined.any(), wrong.status


def test_boxes_as_they_are_come_back_refined() -> None:
    every = "acceptance.min_probability_better=0", "acceptance.min_probability_not_worse=0"
    assert refined(1.0, 1.0, *every).refined.all()


def test_boxes_and_masks_of_another_image_show_no_car() -> None:
    """The images are moved along themselves, so that streets and walls lie under the masks of six cars."""
    scene = load_scene()
    refiner = DirectShapeRefiner(config=load_config("default")).to(scene.detections.T_cam_obj.dtype)
    for shift_px in (150, 330, 520):
        images = {side: getattr(scene.frame, side).roll(shift_px, dims=3) for side in ("images_left", "images_right")}
        result: RefinementResult = refiner(replace(scene.frame, **images), scene.detections)
        assert int(result.refined.sum()) <= 1
        assert Status.rescued not in result.status


def test_masks_of_other_cars_are_refused_by_name() -> None:
    scene = load_scene()
    given, others = scene.detections, torch.arange(len(scene.detections)).roll(1)
    swapped = replace(given, mask_left=given.mask_left.rows(others), mask_right=given.mask_right.rows(others))
    refiner = DirectShapeRefiner(config=load_config("default")).to(given.T_cam_obj.dtype)
    result: RefinementResult = refiner(scene.frame, swapped)
    assert set(result.status) <= {Status.mask_missed, Status.no_match, Status.no_car, Status.rejected_worse}
