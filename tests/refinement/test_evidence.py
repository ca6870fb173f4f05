"""The evidence: its columns against sampling, against hand-made motions, and its blanks."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from typing import Any

import pytest
import torch
from helpers.problems import begun_stage
from helpers.synthetic_scene import cached_street
from torch import Tensor

from directshape_torch.geometry import se3
from directshape_torch.refinement import quality
from directshape_torch.refinement.disparity_profile import DisparityProfile, profile_offsets
from directshape_torch.refinement.observability import covariance_of, covariance_xyz_yaw
from directshape_torch.refinement.quality import EVIDENCE_NAMES, evidence_of_costs, evidence_of_motion, fit_quality
from directshape_torch.terms.cars import CarBatch, CarState


@cache
def motion_at_truth() -> Mapping[str, Any]:
    """Of cars that begin and end at the same place: what `evidence_of_motion` is asked."""
    prior, scene = cached_street()
    stage, state = begun_stage(prior, scene.frames, scene.detections)
    covariance = covariance_of(stage.figures(stage.problem.look(state)).information.sum(dim=1))
    cars = replace(
        CarBatch.from_scene(scene.frames, scene.detections),
        detector_hwl=prior.dimensions_and_derivative(state.code).hwl,
        detector_pose_sigma=torch.tensor([[0.5], [0.25]], dtype=torch.float64).expand(2, 4),
    )
    return {
        "problem": stage.problem,
        "cars": cars,
        "before": state,
        "after": state,
        "covariance": covariance,
        "covariance_xyz_yaw": covariance_xyz_yaw(covariance, state.T_obj_cam),
    }


def of_motion(**changed: Any) -> dict[str, Tensor]:
    return evidence_of_motion(**{**motion_at_truth(), **changed})


def test_a_car_that_did_not_move() -> None:
    found = of_motion()
    torch.testing.assert_close(found["turned"], torch.zeros(2).double(), atol=1e-9, rtol=0)
    torch.testing.assert_close(found["log_expected_gain"], torch.full((2,), math.log(0.005)).double())


def test_who_moved_by_more_than_the_covariance_allows_expects_to_have_gained() -> None:
    after = motion_at_truth()["after"]
    T = se3.inverse(after.T_obj_cam)
    ray = T[:, :3, 3] * torch.tensor([1.0, 0.0, 1.0]).double()
    T[:, :3, 3] -= 0.4 * ray / ray.norm(dim=1, keepdim=True)
    found, still = of_motion(before=CarState.of(se3.inverse(T), after.code)), of_motion()
    assert (found["log_expected_gain"] > still["log_expected_gain"]).all()
    torch.testing.assert_close(found["turned"], still["turned"])


def test_expectations_agree_with_sampling() -> None:
    motion, sigma = (
        torch.tensor([[0.3, -0.1, 0.05, 0.2, 0.0]]).double(),
        torch.tensor([[0.1, 0.2, 0.03, 0.3, 0.1]]).double(),
    )
    hwl = torch.tensor([[1.5, 1.6, 4.0]]).double()
    gain = quality._expected_gain(motion, sigma, hwl)
    noise = sigma * torch.randn(400_000, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    loss = torch.tensor([2 / 4.0, 2 / 1.6, 0.5 * (4 / 1.6 + 1.6 / 4), 1 / 4.0, 1 / 1.6]).double()
    at_output, at_input = ((noise + m).abs() @ loss for m in (0.0, motion))
    torch.testing.assert_close(gain[0], (at_input - at_output).mean(), rtol=2e-2, atol=0)


def test_the_sigma_of_the_heading_is_that_of_the_covariance() -> None:
    found = of_motion(covariance_xyz_yaw=torch.eye(4).double().repeat(2, 1, 1) * 0.01)
    expected = torch.full((2,), math.log(0.1), dtype=torch.float64)
    torch.testing.assert_close(found["log_sigma_yaw"], expected, rtol=1e-9, atol=1e-9)


def test_what_does_not_exist_is_nan_and_touches_no_other_column() -> None:
    assert all(x.isfinite().all() for x in of_motion().values())
    cars, before = motion_at_truth()["cars"], motion_at_truth()["before"]
    sigma = torch.tensor([[torch.inf], [0.5]], dtype=torch.float64).expand(2, 4)
    unknown = of_motion(cars=replace(cars, detector_pose_sigma=sigma))
    assert unknown["log_detector_sigma"].isnan().tolist() == [True, False]
    depth = float(se3.inverse(before.T_obj_cam)[1, 2, 3])
    assert float(unknown["log_detector_sigma"][1]) == pytest.approx(math.log(0.5 / depth))
    singular = of_motion(covariance_xyz_yaw=torch.full((2, 4, 4), torch.nan).double())
    assert singular["log_sigma_yaw"].isnan().all()
    assert singular["log_expected_gain"].isfinite().all()


def test_costs_and_profile_by_hand() -> None:
    """At the input 2 + (x - 2)^2, at the end 3 + 6 (x - 0.25)^2 of 100 pixels; the second car has no curve."""
    x = profile_offsets()
    before, after = (torch.stack([c, c * math.nan]) for c in (2 + (x - 2) ** 2, 3 + 6 * (x - 0.25) ** 2))
    pixels = torch.full((2,), 100.0, dtype=torch.float64)
    cost = torch.tensor([[1.0, 2.0], [3.0, 0.5]], dtype=torch.float64)
    found = evidence_of_costs(2 * cost, cost, DisparityProfile(x, before, after, pixels))
    torch.testing.assert_close(found["relative_decrease"], torch.full((2,), math.log(2)).double())
    expected = {
        "log_profile_contrast": math.log((3 + 6 * 0.75**2) / 3),
        "log_profile_fall_before": math.log(3),
    }
    for name, value in expected.items():
        assert float(found[name][0]) == pytest.approx(value), name
        assert math.isnan(found[name][1])


def test_the_columns_stand_in_their_order_and_a_missed_mask_is_one_of_them() -> None:
    prior, scene = cached_street()
    stage, state = begun_stage(prior, scene.frames, scene.detections)
    seen = stage.problem.look(state)
    columns = {name: torch.full((2,), float(place)) for place, name in enumerate(EVIDENCE_NAMES)}
    quality = fit_quality(stage, stage.figures(seen), seen, columns)
    masks = EVIDENCE_NAMES.index("mask_misfit_left")
    torch.testing.assert_close(quality.evidence[:, masks], 1 - quality.mask_iou_left)
    others = torch.arange(len(EVIDENCE_NAMES)) != masks
    assert (quality.evidence[:, others] == torch.arange(len(EVIDENCE_NAMES))[others]).all()
