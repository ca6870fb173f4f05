"""This module tells the front of a tracked car from its back by the way it drives, where its box was made of masks."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace

import torch
from torch import Tensor

from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import FrameBatch

# Start boxes are off by this share of their distance along the viewing ray, and by this length in any direction.
_SIGMA_SHARE, _SIGMA_M = 0.03, 0.2
# One car of so many drives backwards.
_BACKWARDS_SHARE = 0.01


def along_motion(frames: FrameBatch, detections: Detections) -> tuple[Detections, Tensor]:
    """Turn boxes of masks so that the views of a track agree on the front of their car, and that it drives forwards.

    A car turns by less than a right angle from one view to the next, so all views of a track have one unknown sense.
    Where poses of the camera are known, the way that the car has driven along its headings tells this sense.

    Returns:
        The detections, and the probability (B,) that the front of each car is where its box says: NaN for cars in no
        track, for boxes of a detector, and where poses of the camera are unknown.
    """
    probability = torch.full_like(detections.T_cam_obj[:, 0, 0], torch.nan)
    if detections.track_id is None or detections.is_from_masks is None:
        return detections, probability
    T_cam_obj = detections.T_cam_obj.detach()
    known = detections.is_from_masks & (detections.track_id >= 0) & T_cam_obj.isfinite().flatten(1).all(dim=1)
    T_frame_cam = torch.eye(4).to(T_cam_obj) if frames.T_world_cam is None else frames.T_world_cam
    T = T_frame_cam.expand(len(frames), 4, 4)[detections.frame_index] @ T_cam_obj
    sense = torch.ones_like(probability)
    for rows in _tracks(frames, detections, known):
        of_track, spread_m = _sense_of_track(T[rows], T_cam_obj[rows])
        if frames.T_world_cam is not None:
            way_m = _way(T[rows], of_track)
            forwards = _probability(way_m / spread_m)
            of_track = torch.where(forwards < 0.5, -of_track, of_track)
            probability[rows] = torch.maximum(forwards, 1 - forwards)
        sense[rows] = of_track
    turn = torch.stack([sense, torch.ones_like(sense), sense, torch.ones_like(sense)], dim=1)
    return replace(detections, T_cam_obj=detections.T_cam_obj * turn[:, None]), probability


def _tracks(frames: FrameBatch, detections: Detections, known: Tensor) -> list[list[int]]:
    """The rows of each track, in the order of time."""
    assert detections.track_id is not None
    of_frame = detections.frame_index if frames.time_s is None else frames.time_s[detections.frame_index]
    rows: defaultdict[int, list[tuple[float, int]]] = defaultdict(list)
    values = zip(detections.track_id.tolist(), of_frame.tolist(), known.tolist(), strict=True)
    for row, (track, time, is_known) in enumerate(values):
        if is_known:
            rows[track].append((time, row))
    return [[row for _, row in sorted(views)] for views in rows.values()]


def _sense_of_track(T: Tensor, T_cam_obj: Tensor) -> tuple[Tensor, Tensor]:
    """The sense (R,) of each view, 1 or -1, in which it agrees with the first, and the spread of the way, metres."""
    axis = T[:, :3, 0]
    agrees = torch.where((axis[1:] * axis[:-1]).sum(dim=1) < 0, -1.0, 1.0).to(axis)
    sense = torch.cat([axis.new_ones(1), agrees.cumprod(dim=0)])
    # Only the places of the first and of the last view matter for the whole way.
    ends = T_cam_obj[[0, -1]]
    place = ends[:, :3, 3]
    along_ray = (ends[:, :3, 0] * place).sum(dim=1) / place.norm(dim=1)
    variance = _SIGMA_M**2 + (_SIGMA_SHARE * place.norm(dim=1) * along_ray).square()
    return sense, variance.sum().sqrt()


def _way(T: Tensor, sense: Tensor) -> Tensor:
    """The way that a car has driven along its headings, metres; below 0 if it drove backwards."""
    axis = T[:, :3, 0] * sense[:, None]
    return ((T[1:, :3, 3] - T[:-1, :3, 3]) * 0.5 * (axis[1:] + axis[:-1])).sum()


def _probability(way_in_sigmas: Tensor) -> Tensor:
    """The probability that a car whose way is so many standard deviations along its headings faces forwards."""
    drove_forwards = torch.special.ndtr(way_in_sigmas)
    return torch.lerp(drove_forwards, 1 - drove_forwards, _BACKWARDS_SHARE)
