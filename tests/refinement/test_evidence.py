"""The evidence: its columns against sampling, against hand-made motions, and its blanks."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import pytest
import torch
from helpers.problems import begun_stage, photometric_of
from helpers.synthetic_scene import cached_street
from torch import Tensor

from directshape_torch.geometry import se3
from directshape_torch.refinement import quality
from directshape_torch.refinement.disparity_profile import DisparityProfile, disparity_profile, profile_offsets
from directshape_torch.refinement.observability import covariance_of, covariance_xyz_yaw
from directshape_torch.refinement.quality import EVIDENCE_NAMES, Course, evidence_of
from directshape_torch.terms.cars import CarState


@cache
def course_at_truth() -> Course:
    """Cars that begin and end at the same place, and cost half as much at the end."""
    prior, scene = cached_street()
    stage, state = begun_stage(prior, scene.frames, scene.detections)
    seen = stage.problem.look(state)
    at_end = stage.figures(seen)
    costs, covariance = at_end.term_costs, covariance_of(at_end.information.sum(dim=1))
    surface = photometric_of(stage).where(seen)
    return Course(
        stage=stage,
        before=state,
        after=state,
        detector_hwl=prior.dimensions_and_derivative(state.code).hwl,
        cost_before=2 * costs,
        cost_after=costs,
        figures=at_end,
        seen=seen,
        covariance=covariance,
        covariance_xyz_yaw=covariance_xyz_yaw(covariance, state.T_obj_cam),
        profile=disparity_profile(stage.photometric, surface, surface, 2, state.code),
        detector_sigma=torch.tensor([0.5, 0.25], dtype=torch.float64),
    )


def columns(course: Course, mask_iou_left: float = 0.9) -> dict[str, Tensor]:
    rows = evidence_of(course, torch.full((2,), mask_iou_left, dtype=torch.float64))
    assert rows.shape == (2, len(EVIDENCE_NAMES))
    return dict(zip(EVIDENCE_NAMES, rows.unbind(1), strict=True))


def test_a_car_that_did_not_move() -> None:
    found = columns(course_at_truth())
    torch.testing.assert_close(found["turned"], torch.zeros(2).double(), atol=1e-9, rtol=0)
    torch.testing.assert_close(found["relative_decrease"], torch.full((2,), math.log(2)).double())
    torch.testing.assert_close(found["log_expected_gain"], torch.full((2,), math.log(0.005)).double())
    torch.testing.assert_close(found["mask_misfit_left"], torch.full((2,), 0.1).double())


def test_who_moved_by_more_than_the_covariance_allows_expects_to_have_gained() -> None:
    course = course_at_truth()
    T = se3.inverse(course.after.T_obj_cam)
    ray = T[:, :3, 3] * torch.tensor([1.0, 0.0, 1.0]).double()
    T[:, :3, 3] -= 0.4 * ray / ray.norm(dim=1, keepdim=True)
    moved = replace(course, before=CarState.of(se3.inverse(T), course.after.code))
    found, still = columns(moved), columns(course)
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
    found = columns(replace(course_at_truth(), covariance_xyz_yaw=torch.eye(4).double().repeat(2, 1, 1) * 0.01))
    expected = torch.full((2,), math.log(0.1), dtype=torch.float64)
    torch.testing.assert_close(found["log_sigma_yaw"], expected, rtol=1e-9, atol=1e-9)


def test_what_does_not_exist_is_nan_and_touches_no_other_column() -> None:
    course = course_at_truth()
    blank = columns(course, math.nan)
    assert blank["mask_misfit_left"].isnan().all()
    assert all(x.isfinite().all() for name, x in blank.items() if name != "mask_misfit_left")
    unknown = columns(replace(course, detector_sigma=torch.tensor([torch.inf, 0.5], dtype=torch.float64)))
    assert unknown["log_detector_sigma"].isnan().tolist() == [True, False]
    depth = float(se3.inverse(course.before.T_obj_cam)[1, 2, 3])
    assert float(unknown["log_detector_sigma"][1]) == pytest.approx(math.log(0.5 / depth))
    singular = columns(replace(course, covariance_xyz_yaw=torch.full((2, 4, 4), torch.nan).double()))
    assert singular["log_sigma_yaw"].isnan().all()
    assert singular["relative_decrease"].isfinite().all()


def test_the_profile_by_hand() -> None:
    """At the input 2 + (x - 2)^2, at the end 3 + 6 (x - 0.25)^2 of 100 pixels; the second car has no curve."""
    course = course_at_truth()
    x = profile_offsets()
    before, after = (torch.stack([c, c * math.nan]) for c in (2 + (x - 2) ** 2, 3 + 6 * (x - 0.25) ** 2))
    pixels = torch.full((2,), 100.0, dtype=torch.float64)
    found = columns(replace(course, profile=DisparityProfile(x, before, after, pixels)))
    expected = {
        "log_profile_contrast": math.log((3 + 6 * 0.75**2) / 3),
        "log_profile_fall_before": math.log(3),
    }
    for name, value in expected.items():
        assert float(found[name][0]) == pytest.approx(value), name
        assert math.isnan(found[name][1])
