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
from directshape_torch.refinement import evidence
from directshape_torch.refinement.disparity_profile import DisparityProfile, disparity_profile, profile_offsets
from directshape_torch.refinement.evidence import Agreement, Course, evidence_of
from directshape_torch.refinement.observability import covariance_of, covariance_xyz_yaw
from directshape_torch.refinement.quality import EVIDENCE_NAMES
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
        unsettled=torch.tensor([False, True]),
        profile=disparity_profile(stage.photometric, surface, surface, 2, state.code),
        detector_sigma=torch.tensor([0.5, 0.25], dtype=torch.float64),
    )


def agreement(**changes: float) -> Agreement:
    values = {"mask_iou_left": 0.9, "mask_iou_right": 0.8, "photometric_error_grey": 10.0, "matched_share": 1.0}
    return Agreement(**{name: torch.full((2,), x, dtype=torch.float64) for name, x in (values | changes).items()})


def columns(course: Course, agreed: Agreement | None = None) -> dict[str, Tensor]:
    rows = evidence_of(course, agreement() if agreed is None else agreed)
    assert rows.shape == (2, len(EVIDENCE_NAMES))
    return dict(zip(EVIDENCE_NAMES, rows.unbind(1), strict=True))


def test_a_car_that_did_not_move() -> None:
    found = columns(course_at_truth())
    for name in ("moved_depth", "turned", "length_change", "log_moved_sigmas"):
        torch.testing.assert_close(found[name], torch.zeros(2).double(), atol=1e-9, rtol=0)
    for name in ("silhouette_decrease", "photometric_decrease", "relative_decrease"):
        torch.testing.assert_close(found[name], torch.full((2,), math.log(2)).double())
    torch.testing.assert_close(found["log_expected_gain"], torch.full((2,), math.log(0.005)).double())
    torch.testing.assert_close(found["mask_misfit_right"], torch.full((2,), 0.2).double())
    assert found["unsettled"].tolist() == [0, 1]
    torch.testing.assert_close(found["log_photometric_error"], torch.zeros(2).double())


def test_a_motion_along_the_ray_is_one_of_depth() -> None:
    course = course_at_truth()
    T = se3.inverse(course.after.T_obj_cam)
    ray = T[:, :3, 3] * torch.tensor([1.0, 0.0, 1.0]).double()
    T[:, :3, 3] -= 0.4 * ray / ray.norm(dim=1, keepdim=True)
    moved = replace(course, before=CarState.of(se3.inverse(T), course.after.code))
    found, still = columns(moved), columns(course)
    torch.testing.assert_close(found["moved_depth"], torch.full((2,), 0.4).double())
    assert (found["log_expected_gain"] > still["log_expected_gain"]).all()
    torch.testing.assert_close(found["log_expected_misfit"], still["log_expected_misfit"])
    # At least 0.4 m over the marginal sigma: the Mahalanobis length is no shorter than that of any projection.
    assert (found["log_moved_sigmas"].expm1() >= 0.4 / found["log_sigma_depth"].exp() - 1e-6).all()


def test_expectations_agree_with_sampling() -> None:
    motion, sigma = (
        torch.tensor([[0.3, -0.1, 0.05, 0.2, 0.0]]).double(),
        torch.tensor([[0.1, 0.2, 0.03, 0.3, 0.1]]).double(),
    )
    hwl = torch.tensor([[1.5, 1.6, 4.0]]).double()
    misfit, gain = evidence._expected(motion, sigma, hwl)
    noise = sigma * torch.randn(400_000, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    loss = torch.tensor([2 / 4.0, 2 / 1.6, 0.5 * (4 / 1.6 + 1.6 / 4), 1 / 4.0, 1 / 1.6]).double()
    at_output, at_input = ((noise + m).abs() @ loss for m in (0.0, motion))
    torch.testing.assert_close(misfit[0], at_output.mean(), rtol=5e-3, atol=0)
    torch.testing.assert_close(gain[0], (at_input - at_output).mean(), rtol=2e-2, atol=0)


def test_sigmas_are_along_and_across_the_viewing_ray() -> None:
    """Half a metre along the ray, 2 cm across it and 0.1 rad, of cars to the left and right of the axis."""
    course = course_at_truth()
    location = se3.inverse(course.after.T_obj_cam)[:, :3, 3]
    x, z = (location[:, [0, 2]] / location[:, [0, 2]].norm(dim=1, keepdim=True)).unbind(1)
    assert (x.abs() > 0.05).all()
    zero = torch.zeros_like(x)
    axes = [[0.5 * x, zero, 0.5 * z, zero], [0.02 * z, zero, -0.02 * x, zero], [zero, zero, zero, zero + 0.1]]
    J = torch.stack([torch.stack(row, dim=1) for row in axes], dim=2)
    found = columns(replace(course, covariance_xyz_yaw=J @ J.mT))
    for name, sigma in (("log_sigma_depth", 0.5), ("log_sigma_side", 0.02), ("log_sigma_yaw", 0.1)):
        expected = torch.full((2,), math.log(sigma), dtype=torch.float64)
        torch.testing.assert_close(found[name], expected, rtol=1e-9, atol=1e-9)


def test_conflict_is_what_photometry_alone_would_gain() -> None:
    """With a unit matrix and a pull of length 0.2 at a cost of 1: log(1 + 100 * 0.02)."""
    course = course_at_truth()
    column = course.stage.problem.term_names.index("photometric")
    pull, hessian = torch.ones_like(course.figures.gradient), torch.zeros_like(course.figures.hessian)
    pull[:, column] = 0
    pull[:, column, 3] = 0.2
    hessian[:, 0] = torch.eye(9)
    figures = course.figures._replace(hessian=hessian, gradient=pull)
    cost = torch.full_like(course.cost_after, 1 / course.cost_after.shape[1])
    found = columns(replace(course, figures=figures, cost_after=cost))
    torch.testing.assert_close(found["log_conflict"], torch.full((2,), math.log(3)).double())


def test_what_does_not_exist_is_nan_and_touches_no_other_column() -> None:
    course = course_at_truth()
    blank = columns(course, agreement(mask_iou_right=math.nan))
    assert blank["mask_misfit_right"].isnan().all()
    assert all(x.isfinite().all() for name, x in blank.items() if name != "mask_misfit_right")
    unknown = columns(replace(course, detector_sigma=torch.tensor([torch.inf, 0.5], dtype=torch.float64)))
    assert unknown["log_detector_sigma"].isnan().tolist() == [True, False]
    depth = float(se3.inverse(course.before.T_obj_cam)[1, 2, 3])
    assert float(unknown["log_detector_sigma"][1]) == pytest.approx(math.log(0.5 / depth))
    singular = columns(replace(course, covariance_xyz_yaw=torch.full((2, 4, 4), torch.nan).double()))
    assert singular["log_moved_sigmas"].isnan().all()
    assert singular["relative_decrease"].isfinite().all()


def test_the_profile_by_hand() -> None:
    """At the input 2 + (x - 2)^2, at the end 3 + 6 (x - 0.25)^2 of 100 pixels; the second car has no curve."""
    course = course_at_truth()
    x = profile_offsets()
    before, after = (torch.stack([c, c * math.nan]) for c in (2 + (x - 2) ** 2, 3 + 6 * (x - 0.25) ** 2))
    pixels = torch.full((2,), 100.0, dtype=torch.float64)
    found = columns(replace(course, profile=DisparityProfile(x, before, after, pixels)))
    expected = {
        "log_profile_sigma": math.log(math.sqrt(6 / 1200)),
        "log_profile_offset": math.log(0.3),
        "log_profile_contrast": math.log((3 + 6 * 0.75**2) / 3),
        "profile_offset_before": 2.0,
        "log_profile_fall_before": math.log(3),
        "outside_basin": 0.0,
    }
    for name, value in expected.items():
        assert float(found[name][0]) == pytest.approx(value), name
        assert math.isnan(found[name][1])
