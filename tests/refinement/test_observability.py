"""Covariance and unseen directions are right on cars seen from known sides, by differences and by hand."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import pytest
import torch
from helpers.derivatives import central_differences, moved, tangent_of
from helpers.ellipsoids import ellipsoid_prior
from helpers.problems import DEFAULT, begun_stage, figures_at
from helpers.synthetic_scene import CAMERA_HEIGHT_M, Street, cached_street, street
from torch import Tensor

from directshape_torch.geometry import se3
from directshape_torch.geometry.box3d import pose_from_kitti, rotation_y_from_pose
from directshape_torch.geometry.disparity_field import DisparityField
from directshape_torch.refinement.observability import (
    CAR_QUANTITIES,
    HEADING_LEVER_M,
    Observability,
    covariance_of,
    covariance_xyz_yaw,
    direction_in_words,
    observability_of,
    quantities_jacobian,
    view_in_words,
    without_offset,
)
from directshape_torch.refinement.problem import CarStage
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.state.cars import CarState

LENGTH, DEPTH = (CAR_QUANTITIES.index(name) for name in ("length", "depth"))


@cache
def seen(rotation_y: float, **priors: float) -> Observability:
    """The unseen directions of a car at 9 m, straight ahead, at the truth."""
    prior = ellipsoid_prior()
    scene = street(prior, [(0.0, CAMERA_HEIGHT_M, 9.0)], [rotation_y])
    config = replace(DEFAULT, priors=replace(DEFAULT.priors, **priors))
    stage, state = begun_stage(prior, scene.frames, scene.detections, config)
    with torch.no_grad():
        return observability_of(prior, state, stage.information_of_measurements(figures_at(stage, state)))


def test_from_behind_length_is_what_is_missing_and_depth_goes_with_it() -> None:
    behind = seen(-math.pi / 2)
    weakest = behind.directions[0, 0]
    assert int(weakest.abs().argmax()) == LENGTH
    # The visible end stays where it is: a car longer by one has its middle half of that further away.
    assert 0.2 < float(weakest[DEPTH] / weakest[LENGTH]) < 0.8
    assert behind.words()[0].startswith("rear view: length and depth are uncertain together, 1 to 0.")


def test_from_the_side_length_is_seen() -> None:
    beside = seen(0.0)
    weakest = beside.directions[0, 0]
    assert int(weakest.abs().argmax()) != LENGTH
    assert abs(float(weakest[LENGTH])) < 0.3
    assert beside.words()[0].startswith("side view: ")
    # Its length is known several times better than that of the car seen from behind.
    assert float(sigma_of(beside, LENGTH)) < 0.5 * float(sigma_of(seen(-math.pi / 2), LENGTH))


def sigma_of(view: Observability, quantity: int) -> Tensor:
    """Marginal standard deviation of one quantity: sqrt(sum_i (sigma_i d_i)^2)."""
    return (view.sigmas_m[0] * view.directions[0, :, quantity]).norm()


def test_priors_say_nothing_of_the_view() -> None:
    loose, tight = seen(-math.pi / 2), seen(-math.pi / 2, dimensions_weight=100.0, height_weight=1e4)
    torch.testing.assert_close(tight.sigmas_m, loose.sigmas_m)


def test_directions_are_orthonormal_and_fall_in_sigma() -> None:
    view = seen(0.6)
    torch.testing.assert_close(view.directions[0] @ view.directions[0].T, torch.eye(7).double(), atol=1e-9, rtol=0)
    assert (view.sigmas_m[0].diff() <= 0).all()
    assert (view.directions[0].gather(1, view.directions[0].abs().argmax(1, keepdim=True)) > 0).all()


def test_jacobian_is_the_derivative_of_the_quantities() -> None:
    prior = ellipsoid_prior()
    location = torch.tensor([2.0, 1.6, 15.0]).double()
    T_cam_obj = pose_from_kitti(location, torch.tensor(0.8).double())
    state = CarState.of(se3.inverse(T_cam_obj)[None], torch.tensor([[0.3, -0.2, 0.1]]).double())
    ray = location * torch.tensor([1.0, 0.0, 1.0]).double()
    ray = ray / ray.norm()

    def quantities(delta: Tensor) -> Tensor:
        at = moved(state, delta)
        T = se3.inverse(at.T_obj_cam)[0]
        depth = T[:3, 3] @ ray
        sideways = T[0, 3] * ray[2] - T[2, 3] * ray[0]
        heading = HEADING_LEVER_M * rotation_y_from_pose(T)
        height, width, length = prior.dimensions_and_derivative(at.code).hwl[0]
        return torch.stack([depth, sideways, -T[1, 3], heading, length, width, height])

    expected = central_differences(quantities, tangent_of(state))[:, 0]
    torch.testing.assert_close(quantities_jacobian(prior, state)[0], expected, rtol=1e-6, atol=1e-6)


def test_broken_information_gives_nan_and_no_words() -> None:
    prior = ellipsoid_prior()
    scene = street(prior, [(-2.0, CAMERA_HEIGHT_M, 9.0), (2.0, CAMERA_HEIGHT_M, 9.0)], [0.3, 0.3])
    stage, state = begun_stage(prior, scene.frames, scene.detections)
    with torch.no_grad():
        seen = stage.information_of_measurements(figures_at(stage, state))
    assert seen is not None
    broken = seen.clone()
    broken[1, 0, 2] = torch.nan
    view = observability_of(prior, state, broken)
    assert view.sigmas_m[1].isnan().all()
    assert view.words()[0]
    assert not view.words()[1]
    assert view.sigmas_m[0].isfinite().all()


def test_no_cars_and_no_images() -> None:
    assert Observability.nothing({"B": 0}, torch.zeros(0)).words() == []
    prior = ellipsoid_prior()
    scene = street(prior, [(0.0, CAMERA_HEIGHT_M, 9.0)], [0.3])
    _, state = begun_stage(prior, scene.frames, scene.detections)
    assert observability_of(prior, state, None).words() == [""]


@pytest.mark.parametrize(
    ("direction", "words"),
    [
        ([0, 0, 0, 0, 1, 0, 0], "length alone"),
        ([-0.45, 0, 0, 0, 0.89, 0, 0], "length and depth are uncertain together, 1 to -0.5"),
        ([0.7, 0, 0, 0.5, 0.5, 0, 0], "depth, heading and length are uncertain together, 1 to 0.7 to 0.7"),
    ],
)
def test_words_of_directions(direction: list[float], words: str) -> None:
    assert direction_in_words(direction) == words


def test_words_of_views_follow_the_visible_end() -> None:
    for location, rotation_y, expected in (
        ((0.0, 1.6, 10.0), -math.pi / 2, "rear view"),  # heading along z, away from the camera
        ((0.0, 1.6, 10.0), math.pi / 2, "front view"),
        ((0.0, 1.6, 10.0), math.pi, "side view"),
        ((10.0, 1.6, 10.0), -math.pi / 4, "rear view"),  # heading along its viewing ray
    ):
        alpha = rotation_y - math.atan2(location[0], location[2])
        assert view_in_words(alpha) == expected


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
