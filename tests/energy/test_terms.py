"""Which terms an energy has, priors as terms, and the rig's residual disparity in both crossings."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers.derivatives import moved, relative_error, tangent_of
from helpers.ellipsoids import ellipsoid_prior
from helpers.problems import DEFAULT, PAPER, begun_problem
from helpers.synthetic_scene import Street, cached_street, disturbed

from directshape_torch.config import RefinerConfig
from directshape_torch.energy.photometric_term import PhotometricTerm
from directshape_torch.energy.prior_terms import PriorTerm
from directshape_torch.geometry import se3
from directshape_torch.geometry.disparity_field import DisparityField
from directshape_torch.geometry.stereo import warp_to_right
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.scene import Detections, FrameBatch
from directshape_torch.status import Status


def _names(config: RefinerConfig) -> list[str]:
    prior, scene = cached_street()
    return [term.name for term in DirectShapeRefiner(prior, config).problem(scene.frames, scene.detections)[0].terms]


def test_terms_of_weight_zero_are_left_out() -> None:
    images = ["silhouette_left", "silhouette_right", "photometric"]
    assert _names(DEFAULT) == [*images, "shape", "height", "tilt", "dimensions"]
    assert _names(PAPER) == [*images, "shape", "height", "tilt"]
    assert _names(replace(DEFAULT, silhouette=replace(DEFAULT.silhouette, weight=0.0)))[0] == "photometric"
    no_priors = replace(DEFAULT.priors, shape_weight=0.0, height_weight=0.0, tilt_weight=0.0, dimensions_weight=0.0)
    assert _names(replace(DEFAULT, priors=no_priors)) == images
    assert "photometric" not in _names(replace(DEFAULT, photometric=replace(DEFAULT.photometric, weight=0.0)))


def test_a_prior_costs_half_its_weight_times_the_square() -> None:
    prior, scene = cached_street()
    problem, state = begun_problem(prior, scene.frames, scene.detections)
    state = state._replace(code=torch.tensor([[1.0, 2.0, -2.0], [0.0, 0.0, 3.0]], dtype=torch.float64))
    term = next(t for t in problem.terms if t.name == "shape")
    assert isinstance(term, PriorTerm)
    expected = DEFAULT.priors.shape_weight * torch.tensor([4.5, 4.5], dtype=torch.float64)
    torch.testing.assert_close(term.cost(problem.project(state)), expected)


@pytest.mark.parametrize("sigma", [0.0, 3.0])
def test_the_height_of_a_lifted_car(sigma: float) -> None:
    prior, scene = cached_street()
    problem, state = begun_problem(prior, scene.frames, scene.detections)
    lifted = torch.zeros(2, 9, dtype=torch.float64)
    lifted[:, 1] = 0.2  # v = -motion of the object: its origin rises by 0.2 m
    lifted[:, 6:] = sigma
    term = next(t for t in problem.terms if t.name == "height")
    cost = term.cost(problem.project(moved(state, lifted)))
    torch.testing.assert_close(cost, torch.full_like(cost, DEFAULT.priors.height_weight * 0.02))


def field_of(scene: Street, bias_px: float, vertical_px: float = 0.0) -> DisparityField:
    camera = scene.frames.camera
    height, width = scene.frames.images_left.shape[2:]
    constant = DisparityField.constant(
        bias_px, (width, height), camera.K_left[0], camera.K_right[0], camera.T_right_cam[0]
    ).to(dtype=torch.float64)
    vertical = torch.zeros_like(constant.coefficients)
    vertical[0] = vertical_px
    return replace(constant, vertical_coefficients=vertical)


def biased_street(bias_px: int, rows: int = 0) -> tuple[FrameBatch, Detections]:
    """The street as a rig would see it whose right image comes out `bias_px` further left and `rows` lower."""
    scene = cached_street()[1]
    shift = (rows, -bias_px)
    frames = replace(
        scene.frames,
        images_right=scene.frames.images_right.roll(shift, dims=(2, 3)),
        camera=replace(scene.frames.camera, disparity_field=field_of(scene, float(bias_px), float(rows))),
    )
    return frames, replace(scene.detections, mask_right=scene.detections.mask_right.roll(shift, dims=(1, 2)))


def test_a_biased_rig_with_its_field_equals_a_true_rig() -> None:
    prior, scene = cached_street()
    detections = disturbed(scene.detections)
    true_rig = DirectShapeRefiner(prior, DEFAULT)(scene.frames, detections)
    frames, shifted = biased_street(2, 1)
    biased = DirectShapeRefiner(prior, DEFAULT)(frames, replace(shifted, T_cam_obj=detections.T_cam_obj))
    torch.testing.assert_close(biased.T_cam_obj, true_rig.T_cam_obj, atol=0.1, rtol=0)  # other pixels are sampled
    ignored = replace(frames, camera=replace(frames.camera, disparity_field=None))
    wrong = DirectShapeRefiner(prior, DEFAULT)(ignored, replace(shifted, T_cam_obj=detections.T_cam_obj))
    assert (wrong.T_cam_obj - true_rig.T_cam_obj)[:, :3, 3].norm(dim=1).max() > 0.5


def test_the_photometric_cost_of_a_biased_rig_is_that_of_a_true_one() -> None:
    """Whole pixels of bias and row offset: every lookup finds the very same grey levels."""
    scene = cached_street()[1]
    costs = []
    for frames, detections in ((scene.frames, scene.detections), biased_street(2, 1)):
        problem, state = begun_problem(ellipsoid_prior(), frames, disturbed(detections, 0.05, 0.02))
        term = next(t for t in problem.terms if isinstance(t, PhotometricTerm))
        costs.append(term.pixel_cost(problem.project(state)))
    assert len(costs[0]) == len(costs[1]) > 50
    torch.testing.assert_close(costs[1], costs[0], rtol=1e-8, atol=1e-9)


def test_gradients_hold_with_a_field() -> None:
    frames, detections = biased_street(2, 1)
    problem, state = begun_problem(ellipsoid_prior(), frames, disturbed(detections, 0.05, 0.02))
    for index, part in enumerate(problem.linearise_terms(state)):
        delta = tangent_of(state).requires_grad_()
        (expected,) = torch.autograd.grad(problem.term_costs(moved(state, delta))[:, index].sum(), delta)
        assert relative_error(part.gradient, expected) < 1e-9, problem.terms[index].name


def test_right_rays_are_frozen_at_the_input_depth_and_meet_the_warp_there() -> None:
    """A point of the left pixel (u, v) at the input depth lies on the right ray that starts from its measured pixel."""
    frames, detections = biased_street(2, 1)
    problem, _ = begun_problem(ellipsoid_prior(), frames, detections)
    term = next(t for t in problem.terms if isinstance(t, PhotometricTerm))
    assert (term.pixels.bias_px == 2).all()
    assert (problem.right.bias_px == 2).all()
    camera = frames.camera
    row = 0
    index = problem.right.object_index[row]
    T = camera.T_right_cam[0]
    point = problem.right.origin_cam[row] + 9.0 * problem.right.ray_cam[row]
    seen = warp_to_right(
        point / point[2], point[2], camera.K_right[0], T, *(torch.tensor(x).double() for x in (2.0, 1.0))
    )
    torch.testing.assert_close(seen.uv_right, problem.right.uv[row])
    assert index == 0


def test_a_car_without_a_pose_beside_a_field() -> None:
    frames, detections = biased_street(2, 1)
    T_cam_obj = detections.T_cam_obj.clone()
    T_cam_obj[1] = torch.nan
    result = DirectShapeRefiner(cached_street()[0], DEFAULT)(frames, replace(detections, T_cam_obj=T_cam_obj))
    assert result.status[0].is_refined
    assert result.status[1] is Status.non_finite


def test_a_field_of_another_rig_is_an_error() -> None:
    scene = cached_street()[1]
    other = replace(field_of(scene, 0.5), K_left=scene.frames.camera.K_left[0] * 1.1)
    with pytest.raises(ValueError, match=r"(K_left|intrinsics|rig)"):
        replace(scene.frames, camera=replace(scene.frames.camera, disparity_field=other))


def test_upside_down_is_refused_however_the_prior_sees_it() -> None:
    scene = cached_street()[1]
    roll = se3.exp(torch.tensor([0, 0, 0, torch.pi, 0, 0], dtype=torch.float64))
    upside_down = replace(scene.detections, T_cam_obj=scene.detections.T_cam_obj @ roll)
    result = DirectShapeRefiner(cached_street()[0], DEFAULT)(scene.frames, upside_down)
    assert result.status == [Status.behind_camera] * 2
    assert torch.equal(result.T_cam_obj, upside_down.T_cam_obj)
