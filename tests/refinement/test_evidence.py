"""The evidence that a car is there is strong if halves of one surface agree and errors are below the contrast."""

from __future__ import annotations

from dataclasses import replace

import torch
from helpers.problems import begun_stage
from helpers.synthetic_scene import cached_street
from torch import Tensor

from directshape_torch.refinement.disparity_profile import disparity_profile
from directshape_torch.refinement.quality import FitQuality, fit_quality
from directshape_torch.refinement.trust import EVIDENCE_NAMES
from directshape_torch.scene.frames import FrameBatch


def halves_apart(frames: FrameBatch) -> Tensor:
    prior, scene = cached_street()
    stage, state = begun_stage(prior, frames, scene.detections)
    at = stage.photometric_part(stage.figures(stage.problem.prepare(state)))
    assert at is not None
    return disparity_profile(stage.photometric, at.anchor, at.anchor, len(state.code), state.code).halves_apart


def test_halves_of_one_car_agree_and_those_of_two_places_do_not() -> None:
    scene = cached_street()[1]
    height = scene.frames.images_right.shape[-2]
    right = scene.frames.images_right.clone()
    # Below the middle of the cars everything has two pixels more of disparity.
    line = height // 2 + 8
    right[..., line:, :] = right[..., line:, :].roll(-2, dims=-1)
    whole, torn = (halves_apart(frames) for frames in (scene.frames, replace(scene.frames, images_right=right)))
    assert (whole < 0.3).all()
    assert (torn > whole + 0.5).any()


def quality(distance: Tensor, chances: tuple[Tensor, Tensor]) -> FitQuality:
    prior, scene = cached_street()
    stage, state = begun_stage(prior, scene.frames, scene.detections)
    seen = stage.problem.prepare(state)
    return fit_quality(stage, stage.figures(seen), seen, torch.tensor([0.02, 0.48]).double(), distance, chances)


def test_columns_by_hand_and_a_car_that_is_not_there_is_not_better() -> None:
    ones = torch.ones(2).double()
    found = quality(torch.tensor([1.0, torch.nan]).double(), (ones, 0.5 * ones))
    assert found.evidence.shape == (2, len(EVIDENCE_NAMES))
    torch.testing.assert_close(found.evidence[:, 0].exp(), torch.tensor([0.04, 0.5]).double())
    torch.testing.assert_close(found.evidence[0, 2].exp(), torch.tensor(4.0).double())
    assert found.evidence[1, 2].isnan()
    torch.testing.assert_close(found.probability_not_worse, 0.5 * found.probability_better)
    near, far = (quality(distance * ones, (ones, ones)).probability_better for distance in (2.0, 8.0))
    assert (far < near - 0.05).all()
