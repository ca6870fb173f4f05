"""These tests check the unknown offset of a car's disparity: its effect on the warp, its prior, its limits."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import pytest
import torch
from helpers.ellipsoids import ellipsoid_prior
from helpers.problems import DEFAULT, begun_stage, photometric_of
from helpers.synthetic_scene import TWO_CARS, Street, disturbed, select, street

from directshape_torch.config import RefinerConfig, RigConfig
from directshape_torch.errors import InputError
from directshape_torch.geometry.disparity_field import DisparityField
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import FrameBatch
from directshape_torch.terms.photometric import warped_depth
from directshape_torch.terms.priors import rig_prior

UNSURE = replace(DEFAULT, rig=RigConfig(disparity_sigma_px=1.0))


@cache
def rectified_street() -> Street:
    """A street with a right camera exactly beside the left one, where a constant disparity field is an offset."""
    T_right_cam = torch.eye(4, dtype=torch.float64)
    T_right_cam[0, 3] = -0.53
    return street(ellipsoid_prior(), *TWO_CARS, T_right_cam=T_right_cam)


def _with_field(frames: FrameBatch, value_px: float) -> FrameBatch:
    camera, (height, width) = frames.camera, frames.sizes[0].tolist()
    rig = camera.K_left[0], camera.K_right[0], camera.T_right_cam[0]
    field = DisparityField.constant(value_px, (width, height), *rig)
    return replace(frames, camera=replace(camera, disparity_field=field))


def _unsure(detections: Detections) -> Detections:
    """The disparities of the cars may be wrong by a pixel, whatever field their frames have."""
    return replace(detections, offset_sigma_px=torch.ones(len(detections), dtype=torch.float64))


def _refine(config: RefinerConfig, frames: FrameBatch, detections: Detections) -> RefinementResult:
    result: RefinementResult = DirectShapeRefiner(ellipsoid_prior(), config)(frames, detections)
    return result


@pytest.mark.parametrize("level", [0, 1])
def test_an_offset_does_what_a_constant_field_does(level: int) -> None:
    """Both are measured minus true disparity; in the residuals, and in the depth that the profile starts from."""
    scene, found = rectified_street(), []
    for field_px, offset_px in ((0.3, 0.7), (1.0, 0.0)):
        frames = _with_field(scene.frames, field_px)
        stage, state = begun_stage(
            ellipsoid_prior(), frames, _unsure(disturbed(scene.detections, 0.05, 0.02)), DEFAULT, 1 - level
        )
        state = state._replace(offset_px=torch.full_like(state.offset_px, offset_px))
        stage = stage.problem.begin(1 - level, stage.problem.prepare(state))
        term, prepared = photometric_of(stage), stage.problem.prepare(state)
        at = term.linear(prepared.field, state, term.anchor(prepared))
        again = term.residual(prepared.field, state, at.anchor)
        found.append((at.residual, again, at.anchor.usable, term.pixel_set.support))
        depth, surface = at.anchor.depth, term.anchor(prepared).depth
        torch.testing.assert_close(depth[at.anchor.usable], surface[at.anchor.usable], rtol=1e-6, atol=0)
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-9)
    assert found[0][3].min() > 50


def test_warp_and_prior_by_hand() -> None:
    """Of 80 px m at 8 m, 10 px: 2 px more come from 80 / 12 m; of 10 px less nothing is left, so nothing is seen."""
    scene = rectified_street()
    stage, state = begun_stage(ellipsoid_prior(), scene.frames, scene.detections, UNSURE)
    term = photometric_of(stage)
    per_pixel, sigma_px = torch.tensor([[1 / 80], [0.0]]).double(), torch.tensor([0.5, 0.0]).double()
    cars = replace(term.cars, inverse_depth_of_pixel=per_pixel, offset_sigma_px=sigma_px)
    owner, depth = torch.tensor([0, 1]), torch.full((2, 1), 8.0).double()
    nearer, gone = (state._replace(offset_px=torch.full((2, 1), x).double()) for x in (2.0, -10.0))
    torch.testing.assert_close(warped_depth(cars, depth, nearer, owner)[0], torch.tensor([[80 / 12], [8.0]]).double())
    assert (warped_depth(cars, depth, gone, owner)[0] < 0).tolist() == [[True], [False]]
    prior = rig_prior(cars, nearer)
    assert prior.residual.tolist() == [[4.0], [2.0]]
    assert prior.J_residual_state.tolist() == [[[2.0]], [[1.0]]]


def test_a_disparity_that_is_not_believed_gives_way_to_the_detectors_depth() -> None:
    """The field is wrong by a pixel, 0.9 m and 2.1 m; the detector is right and knows its depth to 5 cm."""
    scene = rectified_street()
    frames, given = _with_field(scene.frames, 1.0), scene.detections
    sigma = torch.tensor([0.05, 0.1, 0.1, 0.05], dtype=torch.float64).expand(2, 4)
    sure = _refine(DEFAULT, frames, given)
    unsure = _refine(DEFAULT, frames, _unsure(replace(given, pose_sigma=sigma)))
    too_far, apart = ((result.T_cam_obj - given.T_cam_obj)[:, 2, 3] for result in (sure, unsure))
    assert (too_far > torch.tensor([0.6, 1.4])).all()
    assert (apart.abs() < 0.05).all()
    # Without a prior of the pose it is the size of the silhouettes that says so, and not as surely.
    unsure = _refine(DEFAULT, frames, _unsure(given))
    assert ((unsure.T_cam_obj - given.T_cam_obj)[:, 2, 3].abs() < 0.15).all()
    assert (unsure.sigma_xyz_yaw[:, 2] > 1.2 * sure.sigma_xyz_yaw[:, 2]).all()
    assert (unsure.observability.sigmas_m[:, 0] > sure.observability.sigmas_m[:, 0]).all()
    assert unsure.covariance.shape == sure.covariance.shape == (2, 9, 9)


def test_a_sigma_of_zero_is_no_unknown_and_beside_other_cars_it_is_held() -> None:
    scene = rectified_street()
    given = disturbed(scene.detections)
    # Cars hide one another, and a car by itself is not hidden.
    config, unsure = (replace(c, sampling=replace(c.sampling, occlusion=False)) for c in (DEFAULT, UNSURE))
    known, none, mixed = (
        _refine(config, scene.frames, replace(given, offset_sigma_px=x))
        for x in (None, torch.zeros(2).double(), torch.tensor([0.0, 0.5]).double())
    )
    assert torch.equal(known.T_cam_obj, none.T_cam_obj)
    assert known.term_names == none.term_names
    assert "rig" in mixed.term_names
    torch.testing.assert_close(mixed.T_cam_obj[0], known.T_cam_obj[0], rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(mixed.covariance[0], known.covariance[0], rtol=1e-7, atol=1e-9)
    assert (mixed.T_cam_obj[1] - known.T_cam_obj[1]).abs().max() > 1e-3
    # The sigmas of the detections win; by themselves cars come to the same.
    alone = [
        replace(select(given, torch.tensor([i])), offset_sigma_px=torch.tensor([s]).double())
        for i, s in ((0, 0.0), (1, 0.5))
    ]
    for i, one in enumerate(alone):
        result = _refine(unsure, scene.frames, one.to(dtype=torch.float64))
        torch.testing.assert_close(result.T_cam_obj[0], mixed.T_cam_obj[i], rtol=1e-9, atol=1e-9)


def test_sigmas_that_are_none_are_refused() -> None:
    given = rectified_street().detections
    with pytest.raises(InputError, match=r"offset_sigma_px: expected finite .* at least 0, pixels, got -1.0 in row 1"):
        replace(given, offset_sigma_px=torch.tensor([0.5, -1.0]).double())
    with pytest.raises(InputError, match="offset_sigma_px"):
        replace(given, offset_sigma_px=torch.ones(3))
