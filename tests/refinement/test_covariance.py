"""The covariance is the inverse Fisher information in the tangent of `retract`, and its image in (x, y, z, yaw)."""

from __future__ import annotations

from dataclasses import replace

import torch
from helpers.derivatives import central_differences, moved, tangent_of
from helpers.ellipsoids import ellipsoid_prior
from helpers.problems import DEFAULT, begun_stage, figures_at
from helpers.synthetic_scene import Street, cached_street

from directshape_torch.geometry import se3
from directshape_torch.geometry.box3d import pose_from_kitti, rotation_y_from_pose
from directshape_torch.geometry.disparity_field import DisparityField
from directshape_torch.refinement.observability import (
    covariance_of,
    covariance_xyz_yaw,
    quantities_jacobian,
    without_offset,
)
from directshape_torch.refinement.problem import CarStage
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.state.cars import CarState


def tangent_covariance(stage: CarStage, state: CarState) -> torch.Tensor:
    return covariance_of(figures_at(stage, state).information.sum(dim=1))


def test_it_is_the_inverse_of_the_summed_fisher_information() -> None:
    prior, scene = cached_street()
    stage, state = begun_stage(prior, scene.frames, scene.detections)
    covariance = tangent_covariance(stage, state)
    fisher = figures_at(stage, state).information.sum(dim=1)
    identity = torch.eye(9, dtype=torch.float64).expand(2, 9, 9)
    torch.testing.assert_close(covariance @ fisher, identity, atol=1e-6, rtol=0)
    torch.testing.assert_close(covariance, covariance.mT)
    assert (torch.linalg.eigvalsh(covariance) > 0).all()


def test_weights_of_the_means_do_not_enter() -> None:
    """Statistical weights: doubling lambda_silh or the term's weight is no new information."""
    prior, scene = cached_street()
    louder = replace(
        DEFAULT,
        silhouette=replace(DEFAULT.silhouette, weight=2 * DEFAULT.silhouette.weight),
        photometric=replace(DEFAULT.photometric, weight=3 * DEFAULT.photometric.weight),
    )
    expected, covariance = (
        tangent_covariance(*begun_stage(prior, scene.frames, scene.detections, c)) for c in (DEFAULT, louder)
    )
    torch.testing.assert_close(covariance, expected, rtol=1e-6, atol=0)


def test_xyz_yaw_is_the_derivative_of_location_and_heading() -> None:
    T_cam_obj = pose_from_kitti(torch.tensor([2.0, 1.6, 15.0]).double(), torch.tensor(0.8).double())
    prior = ellipsoid_prior()
    state = CarState.of(se3.inverse(T_cam_obj)[None], torch.zeros(1, 3).double())

    def xyz_yaw(delta: torch.Tensor) -> torch.Tensor:
        T = se3.inverse(moved(state, delta).T_obj_cam)[0]
        return torch.cat([T[:3, 3], rotation_y_from_pose(T)[None]])

    J = central_differences(xyz_yaw, tangent_of(state))[:, 0]
    A = torch.randn(9, 9, dtype=torch.float64)
    covariance = A @ A.T
    to_quantities = quantities_jacobian(prior, state)
    found = covariance_xyz_yaw(to_quantities @ covariance @ to_quantities.mT, T_cam_obj[None, :3, 3])
    torch.testing.assert_close(found[0], J @ covariance @ J.T, rtol=1e-6, atol=1e-6)


def test_singular_and_broken_systems_give_nan() -> None:
    prior, scene = cached_street()
    weights = replace(DEFAULT.priors, shape_weight=0.0, height_weight=0.0, tilt_weight=0.0, dimensions_weight=0.0)
    blind = replace(
        DEFAULT,
        priors=weights,
        silhouette=replace(DEFAULT.silhouette, weight=0.0),
    )
    stage, state = begun_stage(prior, scene.frames, scene.detections, blind)
    far = state.T_obj_cam.clone()
    far[0, 0, 3] += 500.0  # the first car is nowhere near its pixels
    covariance = tangent_covariance(stage, CarState.of(far, state.code))
    assert covariance[0].isnan().all()
    assert tangent_covariance(stage, CarState.of(far * torch.nan, state.code)).isnan().all()


def test_what_is_known_whatever_the_offset_is_has_the_covariance_of_all_unknowns_without_its_row() -> None:
    A = torch.randn(3, 12, 10, dtype=torch.float64)
    information = A.mT @ A
    marginal = covariance_of(without_offset(information, slice(0, 9)))
    torch.testing.assert_close(marginal, covariance_of(information)[:, :9, :9], rtol=1e-9, atol=1e-9)
    information[0, 9] = information[0, :, 9] = 0
    assert torch.equal(without_offset(information, slice(0, 9))[0], information[0, :9, :9])
    assert torch.equal(without_offset(information, slice(0, 10)), information)


def test_what_is_not_known_of_the_field_widens_depth_alone() -> None:
    prior, scene = cached_street()
    K, T = scene.frames.camera.K_left[0], scene.frames.camera.T_right_cam[0]
    height, width = scene.frames.sizes[0].tolist()
    exact = DisparityField.constant(0.0, (width, height), K, scene.frames.camera.K_right[0], T)
    covariance = torch.zeros(10, 10, dtype=torch.float64)
    covariance[0, 0] = 0.2**2
    known, guessed = (
        refined_covariance(prior, scene, field) for field in (exact, replace(exact, covariance=covariance))
    )
    location = scene.detections.T_cam_obj[:, :3, 3]
    ray = location / location[:, 2:]
    # A pixel of disparity moves a point of depth z by z^2 / (f b) along its ray.
    shift = ray * (0.2 * location[:, 2:] ** 2 / float(K[0, 0] * -T[0, 3]))
    added = (guessed - known)[:, :3, :3]
    torch.testing.assert_close(added, shift[:, :, None] * shift[:, None], rtol=0.05, atol=1e-4)


def refined_covariance(prior: PCAShapePrior, scene: Street, field: DisparityField) -> torch.Tensor:
    """Uncalibrated covariance (B, 4, 4) of the street's cars, refined from their true poses."""
    frames = replace(scene.frames, camera=replace(scene.frames.camera, disparity_field=field))
    result = DirectShapeRefiner(prior, DEFAULT)(frames, scene.detections)
    J = quantities_jacobian(prior, CarState.of(se3.inverse(result.T_cam_obj), result.code))
    return covariance_xyz_yaw(J @ result.covariance @ J.mT, result.T_cam_obj[:, :3, 3])
