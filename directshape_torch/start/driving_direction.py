"""This module tells the front of a tracked car from its back, by all of its views and by the way it drives."""

from __future__ import annotations

from collections import defaultdict

import torch
from torch import Tensor

from directshape_torch.state.cars import CarBatch

# Start boxes are off by this share of their distance along the viewing ray, and by this length in any direction.
_SIGMA_SHARE, _SIGMA_M = 0.03, 0.2
# This share of all cars drives backwards, and this share of a detector's boxes faces the wrong way.
_BACKWARDS_SHARE, _WRONG_SHARE = 0.01, 0.05


def facing_one_way(
    cars: CarBatch,  # B cars with tracks, each with its best start
    is_questioned: Tensor,  # (B,) bool, cars whose front is not given
    probability: Tensor,  # (B,)
) -> tuple[Tensor, Tensor]:
    """Turn start boxes so that all views of a track have the front at one end of their car.

    A car turns by less than a right angle from one view to the next, so the sense of one view gives that of all. The
    mean of what the views say decides, for views of one car are misled alike, together with the way that the car has
    driven along its headings where poses of the camera are known. Views with a given front have a say, too.

    Args:
        cars: the cars; those in no track keep their boxes.
        is_questioned: cars whose front is not given.
        probability: probability that the front is where the box has it, NaN where nothing is known.

    Returns:
        The start poses (B, 4, 4), and the probability (B,) for the turned boxes.
    """
    T_cam_obj = cars.detector_T_cam_obj.detach()
    T = T_cam_obj if cars.T_world_cam is None else cars.T_world_cam @ T_cam_obj
    says = torch.logit(torch.where(is_questioned, probability, 1 - _WRONG_SHARE)).nan_to_num(nan=0.0)
    sense, probability = torch.ones_like(T_cam_obj[:, 0, 0]), probability.clone()
    for rows in _tracks(cars):
        if not bool(is_questioned[rows].any()):
            continue
        of_track = _sense_of_track(T[rows])
        log_odds = (of_track.to(says) * says[rows]).mean()
        if cars.T_world_cam is not None:
            log_odds = log_odds + _log_odds_of_way(T[rows], T_cam_obj[rows], of_track).to(says)
        elif bool((probability[rows].isnan() & is_questioned[rows]).all()):
            log_odds = log_odds + torch.nan
        sense[rows] = torch.where(log_odds < 0, -of_track, of_track)
        probability[rows] = torch.sigmoid(log_odds.abs())
    # The front of a given box stays where it is.
    sense, probability = sense.masked_fill(~is_questioned, 1.0), probability.masked_fill(~is_questioned, torch.nan)
    turn = torch.stack([sense, torch.ones_like(sense), sense, torch.ones_like(sense)], dim=1)
    return cars.detector_T_cam_obj * turn[:, None], probability


def _tracks(cars: CarBatch) -> list[list[int]]:
    """The rows of each track with a finite pose, in the order of time."""
    assert cars.track_id is not None, "the cars have no tracks"
    in_track = (cars.track_id >= 0) & cars.detector_T_cam_obj.isfinite().flatten(1).all(dim=1)
    times = cars.frame_index if cars.time_s is None else cars.time_s
    views: defaultdict[int, list[tuple[float, int]]] = defaultdict(list)
    values = zip(cars.track_id.tolist(), times.tolist(), in_track.tolist(), strict=True)
    for row, (track, time, is_view) in enumerate(values):
        if is_view:
            views[track].append((time, row))
    return [[row for _, row in sorted(of_track)] for of_track in views.values()]


def _sense_of_track(T: Tensor) -> Tensor:
    """The sense (R,) of each view, 1 or -1, in which its heading goes on from that of the first view."""
    axis = T[:, :3, 0]
    goes_on = torch.where((axis[1:] * axis[:-1]).sum(dim=1) < 0, -1.0, 1.0).to(axis)
    return torch.cat([axis.new_ones(1), goes_on.cumprod(dim=0)])


def _log_odds_of_way(T: Tensor, T_cam_obj: Tensor, sense: Tensor) -> Tensor:
    """Log-odds that a car faces forwards, by the way that it has driven along its headings."""
    axis = T[:, :3, 0] * sense[:, None]
    way_m = ((T[1:, :3, 3] - T[:-1, :3, 3]) * 0.5 * (axis[1:] + axis[:-1])).sum()
    # Only the places of the first and of the last view matter for the whole way.
    ends = T_cam_obj[[0, -1]]
    place = ends[:, :3, 3]
    along_ray = (ends[:, :3, 0] * place).sum(dim=1) / place.norm(dim=1)
    variance = _SIGMA_M**2 + (_SIGMA_SHARE * place.norm(dim=1) * along_ray).square()
    drove_forwards = torch.special.ndtr(way_m / variance.sum().sqrt())
    return torch.logit(torch.lerp(drove_forwards, 1 - drove_forwards, _BACKWARDS_SHARE))
