"""This module models a car's way through the frames of its track: a smooth path, from which each view may deviate.

The path is `(x, z, heading)(t) = p + v t + a t^2 / 2` on the ground. Its nine unknowns are shared by the views of a
track, as the code is. The time t is in seconds from the middle of the track. The axes x and z belong to the camera of
the first view, or to the moving camera of each view where the motion of the camera is unknown. A prior pulls `a` to
zero, that is, to constant velocity and turn rate. A row depends on its own view and on the path, never on another view.
The derivation is in docs/derivations/tracks.md.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from directshape_torch.config import TracksConfig
from directshape_torch.geometry import se3
from directshape_torch.solver.sharing import Groups
from directshape_torch.state.cars import CarBatch
from directshape_torch.state.unknowns import POSE, State
from directshape_torch.terms.priors import J_heading_omega, PriorResidual, PriorTerm
from directshape_torch.tracks.state import PATH, TrackState

NUM_PATH = 9
MOTION_NAMES = ("path", "acceleration")
# This is the weight of squared standard deviations; the detector's pose has an equal weight.
MOTION_WEIGHT = 0.2
# A track has no fitting path, or is not of one car, if a view that was refined alone is more than `_FURTHEST` standard
# deviations from the path; the view's own error is taken as `_OWN_SHARE` of its distance and `_OWN_HEADING` radians.
# The motion prior of this track then has the factor `_NEXT_TO_NOTHING`.
_FURTHEST, _OWN_SHARE, _OWN_HEADING, _NEXT_TO_NOTHING = 3.0, 0.01, 0.05, 1e-4
# An acceleration lasts about this long; its rate of change lets views deviate that are far from the middle of a track.
_STEADY_S = 0.3


def follow_paths(config: TracksConfig, cars: CarBatch) -> bool:
    """Whether times are known and paths are requested."""
    return cars.time_s is not None and config.path_sigma_m > 0


def motion_terms(config: TracksConfig, cars: CarBatch) -> list[PriorTerm]:
    """Priors that pull views to their path and the path to constant velocity; empty where cars follow no path."""
    if not follow_paths(config, cars):
        return []

    def of_acceleration(_: CarBatch, state: TrackState) -> PriorResidual:
        return acceleration_prior(state, _of_acceleration(config))

    return [
        PriorTerm(MOTION_NAMES[0], MOTION_WEIGHT, cars, partial(path_prior, config=config), 3, (POSE, PATH)),
        PriorTerm(MOTION_NAMES[1], MOTION_WEIGHT, cars, of_acceleration, 3, (PATH,)),
    ]


def _of_acceleration(config: TracksConfig) -> tuple[float, float, float]:
    along = config.acceleration_sigma_mps2
    return along, along, math.radians(config.turn_acceleration_sigma_dps2)


def deviation_sigma(config: TracksConfig, time_s: Tensor) -> Tensor:
    """Standard deviations (B, 3) of x, z and heading about a path, at times (B,) from its middle.

    The path is a Taylor series, so its error grows with the third power of the time.

    Examples:
        >>> deviation_sigma(TracksConfig(path_sigma_m=0.1, acceleration_sigma_mps2=1.8), torch.tensor([0.0, 1.0]))[:, 0]
        tensor([0.1000, 1.0050])
    """
    here = time_s.new_tensor([config.path_sigma_m, config.path_sigma_m, math.radians(config.path_sigma_yaw_deg)])
    change = time_s.new_tensor(_of_acceleration(config)) / _STEADY_S
    return torch.hypot(here.expand(len(time_s), 3), change * time_s.abs()[:, None] ** 3 / 6)


def path_prior(cars: CarBatch, state: TrackState, config: TracksConfig) -> PriorResidual:
    """Residual of the place on the ground and of the heading against the path (B, 9), in standard deviations.

    The heading counts by its sine, so that a car detected with the opposite heading pulls at nothing.
    """
    place, heading, J_v, J_omega = _on_the_ground(cars, state.T_obj_cam)
    basis = _basis(cars)
    x, z, yaw = (state.path.view(-1, 3, 3) * basis[:, None]).sum(dim=2).unbind(1)
    turned = heading - yaw
    residual = torch.stack([place[:, 0] - x, place[:, 1] - z, torch.sin(turned)], dim=1)
    slope = torch.cos(turned)[:, None]
    J_pose, J_path = residual.new_zeros(len(residual), 3, 6), torch.zeros_like(state.path)[:, None].repeat(1, 3, 1)
    J_pose[:, :2, :3] = J_v
    J_pose[:, 2, 3:] = slope * J_omega
    for row in range(3):
        J_path[:, row, 3 * row : 3 * row + 3] = -basis if row < 2 else -slope * basis
    J = torch.cat([J_pose, J_path], dim=2)
    assert cars.time_s is not None
    per_sigma = 1 / deviation_sigma(config, cars.time_s)
    return PriorResidual(residual * per_sigma, J * per_sigma[:, :, None])


def acceleration_prior(state: TrackState, sigma: tuple[float, float, float]) -> PriorResidual:
    """Acceleration of the path along x and z and of its heading, in standard deviations."""
    per_sigma = 1 / state.path.new_tensor(sigma)
    J = torch.zeros_like(state.path)[:, None].repeat(1, 3, 1)
    for row in range(3):
        J[:, row, 3 * row + 2] = per_sigma[row]
    return PriorResidual(state.path[:, 2::3] * per_sigma, J)


def with_path(
    config: TracksConfig, sharing: Groups, cars: CarBatch, state: TrackState, say: Tensor | None = None
) -> TrackState:
    """Return states (R) with the path of each group that fits its views best.

    States are returned unchanged where there is no motion prior. The weights of the views are `say` (R,), by default
    equal.
    """
    if not follow_paths(config, cars):
        return state
    place, heading, _, _ = _on_the_ground(cars, state.T_obj_cam)
    assert cars.time_s is not None
    seen = torch.cat([place, _continuous(sharing, cars.time_s, heading)[:, None]], dim=1)
    everyone, basis = sharing.all_members, _basis(cars).to(torch.float64)
    weight = 1 / deviation_sigma(config, cars.time_s).to(basis).square()
    weight = weight if say is None else weight * say[:, None]
    columns = []
    for column, sigma in enumerate(_of_acceleration(config)):
        weighted = weight[:, column, None] * basis
        normal = sharing.total(weighted[:, :, None] * basis[:, None], everyone)
        right = sharing.total(weighted * seen[:, column, None], everyone)
        held = torch.diag(normal.new_tensor([0.0, 0.0, 1 / sigma**2]))
        columns.append(torch.linalg.solve(normal + held, right))
    return state._replace(path=torch.cat(columns, dim=1).to(state.code))


def _continuous(sharing: Groups, time_s: Tensor, heading: Tensor) -> Tensor:
    """Headings (R,) without jumps in time.

    Each heading is shifted by a multiple of half a turn, so that it is nearest to the heading of the previous view.
    """
    order = time_s[sharing.rows].masked_fill(~sharing.filled, torch.inf).argsort(dim=1, stable=True)
    rows, filled = sharing.rows.gather(1, order), sharing.filled.gather(1, order)
    in_order = heading[rows]
    twice = 2 * in_order.diff(dim=1)
    turned = torch.atan2(torch.sin(twice), torch.cos(twice)) / 2
    unwound = torch.cat([in_order[:, :1], in_order[:, :1] + turned.cumsum(dim=1)], dim=1)
    return heading.index_put((rows[filled],), unwound[filled])


def hold_of_path(config: TracksConfig, sharing: Groups, cars: CarBatch, alone: State, trusted: Tensor) -> Tensor:
    """Factor (R,) of the motion prior for views with the states `alone`: 1 where a path fits their track.

    A view that is not `trusted` (R,) may be far from the path, because the path may bring it back.
    """
    trusted = trusted | ~sharing.any(trusted)
    fitted = with_path(config, sharing, cars, TrackState.of(alone), torch.where(trusted, 1.0, _NEXT_TO_NOTHING))
    assert cars.time_s is not None
    place, heading, _, _ = _on_the_ground(cars, fitted.T_obj_cam)
    on_path = (fitted.path.view(-1, 3, 3) * _basis(cars)[:, None]).sum(dim=2)
    off, sigma = (place - on_path[:, :2]).norm(dim=1), deviation_sigma(config, cars.time_s)
    own = _OWN_SHARE * fitted.T_obj_cam[:, :3, 3].norm(dim=1)
    turned = torch.sin(heading - on_path[:, 2]).abs()
    too_far = off > _FURTHEST * torch.hypot(sigma[:, 0], own)
    too_far |= turned > _FURTHEST * torch.hypot(sigma[:, 2], torch.full_like(own, _OWN_HEADING))
    return torch.ones_like(off, dtype=torch.float64).masked_fill(sharing.any(too_far & trusted), _NEXT_TO_NOTHING)


def timed(sharing: Groups, cars: CarBatch) -> CarBatch:
    """Views with times from the mean time of their track, and poses of the camera in the camera of its first view."""
    if cars.time_s is None:
        return cars
    T_path_cam = cars.T_world_cam
    if T_path_cam is not None:
        T_path_cam = se3.inverse(T_path_cam[sharing.rows[:, 0]][sharing.of_problem]) @ T_path_cam
    total, count = (sharing.total(x, sharing.all_members) for x in (cars.time_s, torch.ones_like(cars.time_s)))
    return replace(cars, time_s=cars.time_s - total / count, T_world_cam=T_path_cam)


def _basis(cars: CarBatch) -> Tensor:
    assert cars.time_s is not None
    t = cars.time_s
    return torch.stack([torch.ones_like(t), t, 0.5 * t * t], dim=1)


def _on_the_ground(cars: CarBatch, T_obj_cam: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Place (B, 2) and heading (B,) in the axes of the path; derivatives of the place by v, of the heading by omega."""
    T_path_obj = se3.inverse(T_obj_cam)
    if cars.T_world_cam is not None:
        T_path_obj = cars.T_world_cam @ T_path_obj
    R = T_path_obj[:, :3, :3]
    # The origin of the object moves by -R_path_obj v.
    return T_path_obj[:, 0:3:2, 3], torch.atan2(-R[:, 2, 0], R[:, 0, 0]), -R[:, 0::2], J_heading_omega(R)
