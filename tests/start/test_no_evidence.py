"""Depths of boxes made of masks are no evidence of the rig or of a detector, and results are not compared with them."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers.bundled_frame import with_true_boxes
from helpers.problems import DEFAULT
from helpers.synthetic_scene import cached_street, disturbed
from torch import Tensor

from directshape_torch import Detections, DirectShapeRefiner, RigEstimate, Status, check_scene
from directshape_torch.config import AcceptanceConfig
from directshape_torch.io.frame_collation import collate
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.rig.detections import observe_detections

TOGETHER = replace(DEFAULT, priors=replace(DEFAULT.priors, detector_weight=1.0))


def marked(detections: Detections, rows: Tensor) -> Detections:
    return replace(detections, is_from_masks=rows)


@pytest.fixture(scope="module")
def demo() -> LoadedFrame:
    return with_true_boxes()


@pytest.fixture(scope="module")
def mixed() -> tuple[RefinementResult, RefinementResult, Detections]:
    """The two cars of a street refined with boxes of a detector, and with the second box made of masks."""
    prior, scene = cached_street()
    detections = disturbed(scene.detections)
    refiner = DirectShapeRefiner(prior, TOGETHER)
    second = torch.tensor([False, True])
    return refiner(scene.frames, detections), refiner(scene.frames, marked(detections, second)), detections


def test_the_rig_takes_in_boxes_of_a_detector_alone(demo: LoadedFrame) -> None:
    first = torch.arange(6) < 2
    some = observe_detections(demo.frame, marked(demo.detections, first))
    assert some.equal(observe_detections(demo.frame, demo.detections.rows((~first).nonzero()[:, 0])))
    assert len(some)
    rig = RigEstimate.of_frames(demo.frame)
    rig.update(demo.frame, marked(demo.detections, torch.ones(6, dtype=torch.bool)))
    assert not len(rig.rows)
    assert len(rig.sizes)


def test_the_depth_noise_of_a_detector_is_not_that_of_a_mask(demo: LoadedFrame) -> None:
    rig = RigEstimate.of_frames(demo.frame)
    rig.update(demo.frame, demo.detections)
    sigma = rig.informed(demo.frame, marked(demo.detections, torch.arange(6) < 2)).pose_sigma
    assert sigma is not None
    assert sigma[:, 0].isinf().tolist() == [True, True, False, False, False, False]


def test_a_detector_is_learnt_from_its_own_boxes(
    mixed: tuple[RefinementResult, RefinementResult, Detections],
) -> None:
    frames, rigs = cached_street()[1].frames, []
    for result in mixed[:2]:
        rig = RigEstimate.of_frames(frames)
        rig.learn(frames, result)
        rigs.append(rig)
    assert [len(rig.results) for rig in rigs] == [2, 1]
    assert any(rigs[1].results[0].equal(row) for row in rigs[0].results)


def test_the_box_of_the_images_comes_back(mixed: tuple[RefinementResult, RefinementResult, Detections]) -> None:
    with_boxes, found, detections = mixed
    prior, scene = cached_street()
    of_images = DirectShapeRefiner(prior, DEFAULT)(scene.frames, detections)
    assert found.T_cam_obj[0].equal(with_boxes.T_cam_obj[0])
    assert found.T_cam_obj[1].equal(of_images.T_cam_obj[1])
    assert not found.T_cam_obj[1].equal(with_boxes.T_cam_obj[1])
    torch.testing.assert_close(found.comparison.covariance[1], of_images.comparison.covariance[1])
    assert found.comparison.distance_in_sigmas.isnan().tolist() == [False, True]


def test_the_probability_that_the_car_is_there_still_refuses() -> None:
    prior, scene = cached_street()
    detections = marked(scene.detections, torch.tensor([False, True]))
    strict = replace(TOGETHER, acceptance=AcceptanceConfig(1.0, 0.0))
    result = DirectShapeRefiner(prior, strict)(scene.frames, detections)
    assert not result.refined[1]
    assert result.status[1] in (Status.not_trusted, Status.no_car)


def test_probabilities_are_unknown_and_refuse_nothing(
    mixed: tuple[RefinementResult, RefinementResult, Detections],
) -> None:
    found = mixed[1]
    for probability in (found.quality.probability_better, found.quality.probability_not_worse):
        assert probability.isnan().tolist() == [False, True]
    prior, scene = cached_street()
    strict = replace(TOGETHER, acceptance=AcceptanceConfig(0.0, 1.0))
    detections = marked(disturbed(scene.detections), torch.tensor([False, True]))
    assert DirectShapeRefiner(prior, strict)(scene.frames, detections).refined.tolist() == [False, True]


def test_the_mark_goes_with_its_rows(demo: LoadedFrame) -> None:
    marks = torch.arange(6) % 2 == 0
    some = marked(demo.detections, marks)
    assert some.rows(torch.tensor([2, 1])).is_from_masks.tolist() == [True, False]
    assert some.to(dtype=torch.float64).is_from_masks.equal(marks)
    _, together = collate([replace(demo, detections=some), demo])
    assert together.is_from_masks.tolist() == [*marks.tolist(), *[False] * 6]
    assert collate([demo])[1].is_from_masks is None


def test_conventions_are_checked_by_boxes_of_a_detector_alone(demo: LoadedFrame) -> None:
    turned = demo.detections.T_cam_obj.clone()
    turned[:, :3, 0::2] *= -1
    wrong = replace(demo.detections, T_cam_obj=turned, dimensions_hwl=demo.detections.dimensions_hwl[:, [2, 1, 0]])
    assert check_scene(demo.frame, wrong, match_images=False).findings
    assert not check_scene(demo.frame, marked(wrong, torch.ones(6, dtype=torch.bool)), match_images=False).findings
