"""The unseen directions of a view are found on synthetic cars seen from known sides, and by hand."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import pytest
import torch
from helpers.derivatives import central_differences, moved, tangent_of
from helpers.ellipsoids import ellipsoid_prior
from helpers.problems import DEFAULT, begun_stage, figures_at
from helpers.synthetic_scene import CAMERA_HEIGHT_M, street
from torch import Tensor

from directshape_torch.geometry import se3
from directshape_torch.geometry.box3d import pose_from_kitti, rotation_y_from_pose
from directshape_torch.refinement.observability import (
    CAR_QUANTITIES,
    HEADING_LEVER_M,
    Observability,
    direction_in_words,
    observability_of,
    quantities_jacobian,
    view_in_words,
)
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
