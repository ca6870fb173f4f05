"""This module tells the front of a tracked car from its back, by all of its views and by the way it drives."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace

import torch
from torch import Tensor

from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import FrameBatch

# Start boxes are off by this share of their distance along the viewing ray, and by this length in any direction.
_SIGMA_SHARE, _SIGMA_M = 0.03, 0.2
# This share of all cars drives backwards, and this share of a detector's boxes faces the wrong way.
_BACKWARDS_SHARE, _WRONG_SHARE = 0.01, 0.05


def facing_one_way(
    frames: FrameBatch,
    detections: Detections,  # B cars with tracks, each with its best start
    is_questioned: Tensor,  # (B,) bool, cars whose front is not given
    probability: Tensor,  # (B,)
) -> tuple[Detections, Tensor]:
    """Turn start boxes so that all views of a track have the front at one end of their car.

    A car turns by less than a right angle from one view to the next, so the sense of one view gives that of all. The
    mean of what the views say decides, for views of one car are misled alike, together with the way that the car has
    driven along its headings where poses of the camera are known. Views with a given front have a say, too.

    Args:
        frames: the frames of the call.
        detections: the cars; those in no track keep their boxes.
        is_questioned: cars whose front is not given.
        probability: probability that the front is where the box has it, NaN where nothing is known.

    Returns:
        The detections, and the probability (B,) for the turned boxes.
    """
    assert detections.track_id is not None, "the cars have no tracks"
    T_cam_obj = detections.T_cam_obj.detach()
    in_track = (detections.track_id >= 0) & T_cam_obj.isfinite().flatten(1).all(dim=1)
    has_poses, eye = frames.T_world_cam is not None, torch.eye(4).to(T_cam_obj)[None]
    T_frame_cam = eye.expand(len(frames), 4, 4) if frames.T_world_cam is None else frames.T_world_cam
    T = T_frame_cam[detections.frame_index] @ T_cam_obj
    says = torch.logit(torch.where(is_questioned, probability, 1 - _WRONG_SHARE)).nan_to_num(nan=0.0)
    sense, probability = torch.ones_like(T_cam_obj[:, 0, 0]), probability.clone()
    for rows in _tracks(frames, detections, in_track):
        if not bool(is_questioned[rows].any()):
            continue
        of_track = _sense_of_track(T[rows])
        log_odds = (of_track.to(says) * says[rows]).mean()
        if not has_poses and bool((probability[rows].isnan() & is_questioned[rows]).all()):
            log_odds = log_odds + torch.nan
        if has_poses:
            log_odds = log_odds + _log_odds_of_way(T[rows], T_cam_obj[rows], of_track).to(says)
        sense[rows] = torch.where(log_odds < 0, -of_track, of_track)
        probability[rows] = torch.sigmoid(log_odds.abs())
    # The front of a given box stays where it is.
    sense, probability = sense.masked_fill(~is_questioned, 1.0), probability.masked_fill(~is_questioned, torch.nan)
    turn = torch.stack([sense, torch.ones_like(sense), sense, torch.ones_like(sense)], dim=1)
    return replace(detections, T_cam_obj=detections.T_cam_obj * turn[:, None]), probability


def _tracks(frames: FrameBatch, detections: Detections, in_track: Tensor) -> list[list[int]]:
    """The rows of each track, in the order of time."""
    assert detections.track_id is not None
    times = detections.frame_index if frames.time_s is None else frames.time_s[detections.frame_index]
    views: defaultdict[int, list[tuple[float, int]]] = defaultdict(list)
    values = zip(detections.track_id.tolist(), times.tolist(), in_track.tolist(), strict=True)
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
