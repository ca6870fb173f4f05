"""Covariance: the inverse Fisher information in the tangent of `retract`, and its image in (x, y, z, yaw)."""

from __future__ import annotations

from dataclasses import replace

import torch
from helpers.derivatives import central_differences, moved, tangent_of
from helpers.problems import DEFAULT, begun_stage, figures_at
from helpers.synthetic_scene import cached_street

from directshape_torch.diagnosis.covariance import covariance_of, covariance_xyz_yaw, shared_disparity_covariance
from directshape_torch.geometry import se3
from directshape_torch.geometry.box3d import pose_from_kitti, rotation_y_from_pose
from directshape_torch.problem import CarStage
from directshape_torch.terms.cars import CarState


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


def test_far_cars_are_less_certain() -> None:
    prior, scene = cached_street()
    stage, state = begun_stage(prior, scene.frames, scene.detections)
    variance = covariance_xyz_yaw(tangent_covariance(stage, state), state.T_obj_cam).diagonal(dim1=1, dim2=2)
    assert (variance > 0).all()
    assert variance[1, 2] > variance[0, 2]  # along the viewing direction, at 12.5 m against 8 m


def test_xyz_yaw_is_the_derivative_of_location_and_heading() -> None:
    T_cam_obj = pose_from_kitti(torch.tensor([2.0, 1.6, 15.0]).double(), torch.tensor(0.8).double())
    state = CarState(se3.inverse(T_cam_obj)[None], torch.zeros(1, 3).double())

    def xyz_yaw(delta: torch.Tensor) -> torch.Tensor:
        T = se3.inverse(moved(state, delta).T_obj_cam)[0]
        return torch.cat([T[:3, 3], rotation_y_from_pose(T)[None]])

    J = central_differences(xyz_yaw, tangent_of(state))[:, 0]
    A = torch.randn(9, 9, dtype=torch.float64)
    covariance = (A @ A.T)[None]
    expected = J @ covariance[0] @ J.T
    torch.testing.assert_close(covariance_xyz_yaw(covariance, state.T_obj_cam)[0], expected, rtol=1e-6, atol=1e-6)


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
    covariance = tangent_covariance(stage, CarState(far, state.code))
    assert covariance[0].isnan().all()
    assert tangent_covariance(stage, CarState(far * torch.nan, state.code)).isnan().all()


def test_an_error_that_all_pixels_share_moves_the_car_along_its_ray_by_the_depth_that_it_feigns() -> None:
    location = torch.tensor([-6.0, 1.6, 30.0]).double()
    T_obj_cam = se3.inverse(pose_from_kitti(location, torch.tensor(0.8).double()))[None]
    focal_baseline, sigma_px = 721.5 * 0.54, 0.1
    shared = shared_disparity_covariance(T_obj_cam, torch.tensor([focal_baseline]).double(), sigma_px, 9)
    disparity = focal_baseline / location[2]
    feigned = location * (focal_baseline / (disparity - 1e-4) / location[2] - 1) / 1e-4 * sigma_px
    expected = torch.zeros(4, 4).double()
    expected[:3, :3] = torch.outer(feigned, feigned)
    torch.testing.assert_close(covariance_xyz_yaw(shared, T_obj_cam)[0], expected, rtol=1e-4, atol=1e-12)
