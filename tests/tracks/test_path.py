"""The motion prior has right derivatives and the right path, and its effect on the views of a track is right."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import pytest
import torch
from helpers.ellipsoids import ellipsoid_prior
from helpers.ground import cars_on
from helpers.synthetic_scene import CAMERA_HEIGHT_M, cached_street, disturbed, joined_detections, joined_frames, street
from helpers.track_drive import QUICK
from torch import Tensor

from directshape_torch.config import TracksConfig
from directshape_torch.errors import InputError
from directshape_torch.geometry import se3
from directshape_torch.numerics.tables import take_rows
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import FrameBatch
from directshape_torch.solver.sharing import Groups
from directshape_torch.state.cars import CarBatch, CarState
from directshape_torch.tracks.path import hold_of_path, motion_terms, timed, with_path
from directshape_torch.tracks.state import TrackState

CONFIG = TracksConfig()
TIMES = torch.tensor([0.0, 0.1, 0.3, 0.4, 1.0], dtype=torch.float64)


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def views(with_camera: bool, num_offsets: int = 0) -> tuple[CarBatch, TrackState]:
    """Five random views."""
    cars, T_obj_cam = cars_on(random(3), random(1), 5), se3.exp(random(5, 6))
    T_world_cam = se3.exp(random(5, 6, seed=1)) if with_camera else None
    offset_px, path = random(5, num_offsets, seed=3), random(5, 9, seed=4)
    state = TrackState.of(CarState(T_obj_cam, random(5, 3, seed=2), offset_px))._replace(path=path)
    return replace(cars, time_s=TIMES, T_world_cam=T_world_cam), state


def on_a_path(path: Tensor, T_world_cam: Tensor | None) -> TrackState:
    """States at `TIMES` on a path (9,) whose times count from their mean."""
    t = TIMES - TIMES.mean()
    x, z, yaw = (path.view(3, 3) @ torch.stack([torch.ones_like(t), t, t * t / 2])).unbind(0)
    cosine, sine, nothing, one = torch.cos(yaw), torch.sin(yaw), torch.zeros_like(yaw), torch.ones_like(yaw)
    R = torch.stack([cosine, nothing, sine, nothing, one, nothing, -sine, nothing, cosine], dim=1).view(5, 3, 3)
    T_path_obj = se3.from_rotation_translation(R, torch.stack([x, 1.6 * one, z], dim=1))
    if T_world_cam is not None:
        T_path_obj = se3.inverse(T_world_cam) @ T_world_cam[:1] @ T_path_obj
    return TrackState.of(CarState.of(se3.inverse(T_path_obj), random(5, 3)))


def test_a_car_may_turn_back() -> None:
    """By more than a quarter turn from its first view, in the frames of any order."""
    cars, _ = views(with_camera=False)
    mixed = torch.tensor([3, 0, 4, 1, 2])
    turning = torch.tensor([1.0, 2.0, 0.3, 9.0, -3.0, 0.0, 0.4, 2.0, 0.0], dtype=torch.float64)
    cars, state = replace(cars, time_s=TIMES[mixed]), take_rows(on_a_path(turning, None), mixed)
    sharing = Groups.from_numbers([7] * 5, torch.arange(6), torch.arange(6, 9))
    cars = timed(sharing, cars)
    path = with_path(CONFIG, sharing, cars, state).path
    modulo = (path[:, 6] - turning[6] + math.pi / 2) % math.pi - math.pi / 2
    torch.testing.assert_close(modulo, torch.zeros(5, dtype=torch.float64))
    torch.testing.assert_close(path[:, 7], turning[7].expand(5))
    assert hold_of_path(CONFIG, sharing, cars, state, sharing.all_members).tolist() == [1.0] * 5
    # With its acceleration the path itself is where the car is.
    place, _ = motion_terms(CONFIG, cars)
    assert place.residual_of(cars, state._replace(path=turning.expand(5, 9))).residual.abs().max() < 1e-9


@pytest.mark.parametrize("backwards", [False, True])
@pytest.mark.parametrize("with_camera", [False, True])
def test_the_path_of_cars_on_a_path_is_found_and_costs_nothing(with_camera: bool, backwards: bool) -> None:
    cars, _ = views(with_camera)
    path = torch.tensor([2.0, 5.0, 0.0, 14.0, -3.0, 0.0, 2.9, 0.8, 0.0], dtype=torch.float64)
    state = on_a_path(path, cars.T_world_cam)
    if backwards:
        half_turn = se3.exp(torch.tensor([0, 0, 0, 0, math.pi, 0], dtype=torch.float64))
        state.T_obj_cam[2] = half_turn @ state.T_obj_cam[2]
    sharing = Groups.from_numbers([4] * 5, own=torch.arange(6), shared=torch.arange(6, 9))
    of_track = timed(sharing, cars)
    found = with_path(CONFIG, sharing, of_track, state)
    torch.testing.assert_close(found.path, path.expand(5, 9), rtol=0, atol=1e-8)
    for term in motion_terms(CONFIG, of_track):
        assert term.residual_of(of_track, found).residual.abs().max() < 1e-6


def test_the_fitted_path_is_the_cheapest_for_views_where_they_are() -> None:
    cars, state = views(with_camera=False)
    sharing = Groups.from_numbers([1, 2, 1, 1, 2], own=torch.arange(6), shared=torch.arange(6, 9))
    of_track = timed(sharing, cars)
    upright = state._replace(T_obj_cam=on_a_path(0.3 * random(9), None).T_obj_cam)
    fitted = with_path(CONFIG, sharing, of_track, upright)
    assert torch.equal(fitted.path[0], fitted.path[2])
    place, acceleration = motion_terms(CONFIG, of_track)

    def cost(path: Tensor) -> Tensor:
        at = fitted._replace(path=path)
        share = 1 / sharing.total(torch.ones(5, dtype=torch.float64), torch.ones(5, dtype=torch.bool))
        once = share * acceleration.residual_of(of_track, at).residual.square().sum(dim=1)
        # The heading as it is fitted, not its sine.
        of_place = place.residual_of(of_track, at).residual[:, :2].square().sum(dim=1)
        return (of_place + once).sum()

    path = fitted.path.clone().requires_grad_()
    (slope,) = torch.autograd.grad(cost(path), path)
    summed = sharing.total(slope[:, :6].sum(dim=1), torch.ones(5, dtype=torch.bool))
    assert summed.abs().max() < 1e-6 * float(cost(path).detach() + 1)


@cache
def seen() -> tuple[FrameBatch, Detections]:
    """Three frames of a car that drives straight ahead, with disturbed boxes, which must not be changed."""
    prior, code = ellipsoid_prior(), torch.tensor([[0.5, -0.4, 0.3]], dtype=torch.float64)
    views = [street(prior, [(-1.0, CAMERA_HEIGHT_M, 9.0 + n)], [1.3], code) for n in range(3)]
    detections = joined_detections([view.detections for view in views], (120, 160))
    track = replace(disturbed(detections), track_id=torch.zeros(3, dtype=torch.long))
    return joined_frames([view.frames for view in views]), track


def drive(time_s: Tensor | None, T_world_cam: Tensor | None = None) -> tuple[FrameBatch, Detections]:
    """The three frames at these times, from a camera that moves."""
    frames, detections = seen()
    return replace(frames, time_s=time_s, T_world_cam=T_world_cam), detections


def refined(
    time_s: Tensor | None, config: TracksConfig = CONFIG, T_world_cam: Tensor | None = None
) -> RefinementResult:
    settings = replace(QUICK, tracks=config)
    result: RefinementResult = DirectShapeRefiner(ellipsoid_prior(), settings)(*drive(time_s, T_world_cam))
    return result


# What the images say of the motion would speak against a path that is pushed.
STIFF = TracksConfig(next_view_weight=0.0, path_sigma_m=1e-3, path_sigma_yaw_deg=0.05, acceleration_sigma_mps2=1e-2)
AT = torch.tensor([0.0, 0.1, 0.2], dtype=torch.float64)


def bend(result: RefinementResult) -> float:
    """Second difference of the positions, metres."""
    x = result.T_cam_obj[:, :3, 3]
    return float((x[0] - 2 * x[1] + x[2])[[0, 2]].norm())


def test_times_make_the_path_smooth_and_without_them_nothing_changes() -> None:
    plain, held = refined(None, STIFF), refined(AT, STIFF)
    assert plain.term_names == tuple(n for n in held.term_names if n not in ("path", "acceleration"))
    assert bend(held) < 0.3 * bend(plain)
    assert held.status == plain.status
    off = refined(AT, replace(STIFF, path_sigma_m=0.0))
    assert off.term_names == plain.term_names
    assert torch.equal(off.T_cam_obj, plain.T_cam_obj)
    assert torch.equal(off.code, plain.code)


def test_where_the_world_is_does_not_matter_and_where_the_camera_goes_does() -> None:
    still = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    elsewhere = se3.exp(torch.tensor([3.0, 0.0, -7.0, 0.0, 0.0, 0.0], dtype=torch.float64)) @ still
    jerky = still.clone()
    jerky[1, 2, 3] = 0.5
    at_rest, by_itself, shifted, pushed = (refined(AT, STIFF, T) for T in (still, None, elsewhere, jerky))
    torch.testing.assert_close(at_rest.T_cam_obj, by_itself.T_cam_obj, rtol=0, atol=1e-9)
    torch.testing.assert_close(at_rest.T_cam_obj, shifted.T_cam_obj, rtol=0, atol=1e-9)
    assert (pushed.T_cam_obj - at_rest.T_cam_obj)[1, 2, 3] < -0.05


def test_what_cannot_be_a_time_or_a_pose_is_refused() -> None:
    with pytest.raises(InputError, match=r"frames\.time_s: expected another time for each view of a track, got 0\.1 s"):
        refined(torch.tensor([0.0, 0.1, 0.1], dtype=torch.float64))
    with pytest.raises(InputError, match="time_s: expected finite numbers"):
        drive(torch.tensor([0.0, torch.nan, 0.1], dtype=torch.float64))
    with pytest.raises(InputError, match="time_s"):
        drive(AT[:2])
    with pytest.raises(InputError, match="T_world_cam: expected finite numbers"):
        drive(AT, torch.full((3, 4, 4), torch.inf, dtype=torch.float64))
    with pytest.raises(InputError, match="T_world_cam"):
        drive(AT, 2 * torch.eye(4, dtype=torch.float64).repeat(3, 1, 1))
    with pytest.raises(InputError, match="T_world_cam: expected 0, 0, 0, 1 as last rows"):
        drive(AT, torch.block_diag(torch.eye(3), torch.tensor([[2.0]])).double().repeat(3, 1, 1))


@pytest.mark.parametrize("name", ["time_s", "T_world_cam"])
def test_numbers_too_large_for_their_dtype_are_refused(name: str) -> None:
    frames = cached_street()[1].frames.to(dtype=torch.float32)
    T_world_cam = torch.eye(4)[None]
    T_world_cam[:, 0, 3] = 5.4e6
    far = {"time_s": torch.tensor([1.3e9]), "T_world_cam": T_world_cam}[name]
    with pytest.raises(
        InputError, match=f"{name}: expected numbers near 0, exact to .*take those of the first frame off"
    ):
        replace(frames, **{name: far})


@pytest.mark.parametrize(
    ("jump_m", "turned_deg", "hold"),
    [(0, 0, 1.0), (0.3, 0, 1.0), (4, 0, 1e-4), (0, 4, 1.0), (0, 60, 1e-4), (0, 180, 1.0)],
)
def test_a_track_that_jumps_or_heads_elsewhere_is_held_by_next_to_nothing(
    jump_m: float, turned_deg: float, hold: float
) -> None:
    """Three of five views are moved aside, or one is turned; half a turn is the detector's affair."""
    cars, _ = views(with_camera=False)
    sharing = Groups.from_numbers([4] * 5, own=torch.arange(6), shared=torch.arange(6, 9))
    path = torch.tensor([0.0, 0.0, 0.0, 20.0, 9.0, 0.0, 1.6, 0.0, 0.0], dtype=torch.float64)
    state = on_a_path(path, None)
    turn = torch.tensor([0, 0, 0, 0, math.radians(turned_deg), 0], dtype=torch.float64)
    state.T_obj_cam[2] = se3.exp(turn) @ state.T_obj_cam[2]
    T_cam_obj = se3.inverse(state.T_obj_cam)
    T_cam_obj[2:, 0, 3] += jump_m
    state = CarState.of(se3.inverse(T_cam_obj), random(5, 3))
    assert hold_of_path(CONFIG, sharing, timed(sharing, cars), state, sharing.all_members).tolist() == [hold] * 5


@pytest.mark.parametrize(("trusted", "hold"), [((0, 1, 2, 3, 4), 1e-4), ((0, 1, 3, 4), 1.0), ((), 1e-4)])
def test_a_view_that_is_not_trusted_takes_the_path_from_nobody(trusted: tuple[int, ...], hold: float) -> None:
    cars, _ = views(with_camera=False)
    sharing = Groups.from_numbers([4] * 5, own=torch.arange(6), shared=torch.arange(6, 9))
    path = torch.tensor([0.0, 0.0, 0.0, 20.0, 9.0, 0.0, 1.6, 0.0, 0.0], dtype=torch.float64)
    T_cam_obj = se3.inverse(on_a_path(path, None).T_obj_cam)
    T_cam_obj[2, 0, 3] += 8.0
    state = CarState.of(se3.inverse(T_cam_obj), random(5, 3))
    is_trusted = torch.zeros(5, dtype=torch.bool).index_fill(0, torch.tensor(trusted, dtype=torch.long), True)
    assert hold_of_path(CONFIG, sharing, timed(sharing, cars), state, is_trusted).tolist() == [hold] * 5
