"""This module moves the camera and every car of a scene, for rendered sequences."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from demo_scene.camera import Array, CameraPose
from demo_scene.layout import (
    EGO_LANE_M,
    ONCOMING_LANE_M,
    PARKED_LEFT_M,
    PARKED_RIGHT_M,
    SceneLayout,
    draw_camera,
    draw_sun,
    dress,
    pose_on_road,
)

_AWAY, _TOWARDS = -0.5 * np.pi, 0.5 * np.pi
_STEP_S = 0.005


@dataclass(frozen=True)
class Drive:
    """A `Drive` is a drive on the ground at constant speed: start in metres, KITTI's `rotation_y`, and turns."""

    x_m: float
    z_m: float
    rotation_y: float
    speed_m_s: float = 0.0
    # Turns are `(duration_s, rate_rad_s)`, positive to the right; the drive is straight after the last turn.
    turns: tuple[tuple[float, float], ...] = ()

    def at(self, time_s: float) -> tuple[float, float, float]:
        """Position x, z in metres and `rotation_y` at a time.

        Examples:
            >>> [round(n, 3) for n in Drive(0.0, 5.0, -np.pi / 2, 10.0).at(0.5)]
            [0.0, 10.0, -1.571]
        """
        times = np.linspace(0.0, time_s, max(round(time_s / _STEP_S), 1) + 1)
        ends = np.cumsum([duration for duration, _ in self.turns])
        heading = np.full_like(times, self.rotation_y)
        for (duration, rate), end in zip(self.turns, ends, strict=True):
            heading += rate * np.clip(times - (end - duration), 0.0, duration)
        middle = 0.5 * (heading[1:] + heading[:-1])
        path_m = self.speed_m_s * np.diff(times)
        x, z = self.x_m + (path_m * np.cos(middle)).sum(), self.z_m - (path_m * np.sin(middle)).sum()
        return float(x), float(z), float(heading[-1])


def sample_sequence(seed: int, num_frames: int, interval_s: float) -> list[SceneLayout]:
    """A scene at `num_frames` times; cars keep their numbers. The kind of traffic depends on the seed in turn."""
    rng = np.random.default_rng(seed)
    camera, sun = draw_camera(rng), draw_sun(rng)
    kind = _KINDS[seed % len(_KINDS)]
    times = [k * interval_s for k in range(num_frames)]
    while True:
        ego, drives = kind(rng)
        if not _collide(drives, times):
            break
    cars = [dress(rng, np.eye(4)) for _ in drives]
    layouts = []
    for time_s in times:
        placed = [replace(car, T_road_obj=pose_on_road(*d.at(time_s))) for car, d in zip(cars, drives, strict=True)]
        layouts.append(SceneLayout(seed, _moved(camera, ego, time_s), tuple(placed), *sun))
    return layouts


def _moved(camera: CameraPose, ego: Drive, time_s: float) -> CameraPose:
    x, z, rotation_y = ego.at(time_s)
    return replace(camera, x_m=x, z_m=z, yaw_rad=rotation_y - _AWAY)


def _collide(drives: list[Drive], times: list[float]) -> bool:
    """Whether two cars touch, each modelled by three discs of 1.05 m along its length."""
    for time_s in times:
        discs = [_discs(d, time_s) for d in drives]
        for k, first in enumerate(discs):
            for second in discs[k + 1 :]:
                if np.linalg.norm(first[:, None] - second[None], axis=-1).min() < 2.1:
                    return True
    return False


def _discs(drive: Drive, time_s: float) -> Array:
    x, z, rotation_y = drive.at(time_s)
    along = np.array([-1.5, 0.0, 1.5])[:, None]
    return np.array([x, z]) + along * np.array([np.cos(rotation_y), -np.sin(rotation_y)])


def _change_lane(side_m: float, speed_m_s: float, wait_s: float) -> tuple[tuple[float, float], ...]:
    """Turns that move by `side_m` to the right (negative: left) within about two seconds: a bend and its opposite."""
    rate = side_m / speed_m_s
    return (wait_s, 0.0), (1.0, rate), (1.0, -rate)


def _parked(rng: np.random.Generator, z_m: float, side: str) -> Drive:
    x = PARKED_RIGHT_M if side == "right" else PARKED_LEFT_M
    heading = _AWAY if side == "right" else _TOWARDS
    return Drive(x + rng.normal(0, 0.06), z_m + rng.uniform(-0.3, 0.3), heading + rng.normal(0, 0.04))


def _passing_parked(rng: np.random.Generator) -> tuple[Drive, list[Drive]]:
    """Traffic in which the camera passes parked cars, which hide each other, behind a car."""
    ego = Drive(EGO_LANE_M, 0.0, _AWAY, rng.uniform(3.5, 4.5))
    ahead = Drive(EGO_LANE_M + rng.normal(0, 0.15), rng.uniform(14.0, 18.0), _AWAY, rng.uniform(4.0, 6.0))
    near, far = rng.uniform(13.5, 15.0), rng.uniform(17.0, 19.0)
    return ego, [ahead, _parked(rng, near, "right"), _parked(rng, near + 6.0, "right"), _parked(rng, far, "left")]


def _turning(rng: np.random.Generator) -> tuple[Drive, list[Drive]]:
    """Traffic in which the car ahead turns round to the left, in front of an oncoming car and parked ones."""
    ego = Drive(EGO_LANE_M, 0.0, _AWAY, rng.uniform(0.5, 2.0))
    speed, radius = rng.uniform(3.8, 4.6), rng.uniform(4.0, 4.8)
    turns = ((0.3, 0.0), (rng.uniform(2.2, 2.8), -speed / radius))
    around = Drive(EGO_LANE_M + rng.uniform(0.6, 1.0), rng.uniform(11.0, 13.0), _AWAY, speed, turns)
    oncoming = Drive(ONCOMING_LANE_M + rng.normal(0, 0.15), rng.uniform(33.0, 36.0), _TOWARDS, rng.uniform(3.5, 4.5))
    return ego, [around, oncoming, _parked(rng, rng.uniform(9.5, 11.0), "right"), _parked(rng, 24.0, "left")]


def _overtaking(rng: np.random.Generator) -> tuple[Drive, list[Drive]]:
    """Traffic in which a car ahead overtakes another on the left, cuts in and hides it for a while."""
    ego = Drive(EGO_LANE_M, 0.0, _AWAY, rng.uniform(6.0, 7.0))
    slow, fast = rng.uniform(5.0, 6.0), rng.uniform(10.0, 11.0)
    slower = Drive(EGO_LANE_M + rng.uniform(0.4, 0.7), rng.uniform(15.0, 16.5), _AWAY, slow)
    faster = Drive(ONCOMING_LANE_M + 0.6, rng.uniform(8.0, 9.0), _AWAY, fast, _change_lane(2.7, fast, 1.0))
    return ego, [slower, faster, _parked(rng, rng.uniform(23.0, 26.0), "right"), _parked(rng, 30.0, "left")]


def _pulling_out(rng: np.random.Generator) -> tuple[Drive, list[Drive]]:
    """Traffic in which a parked car pulls out ahead and an oncoming one turns across the road, both in bends."""
    ego = Drive(EGO_LANE_M, 0.0, _AWAY, rng.uniform(2.0, 3.0), ((1.0, 0.0), (1.5, rng.uniform(0.02, 0.06))))
    out = rng.uniform(3.2, 4.0)
    leaving = Drive(PARKED_RIGHT_M - 0.3, rng.uniform(9.5, 11.0), _AWAY - 0.15, out, ((0.8, -0.45), (1.2, 0.5)))
    across = rng.uniform(4.0, 5.0)
    turns = ((0.4, 0.0), (1.6, -across / rng.uniform(5.5, 6.5)))
    crossing = Drive(ONCOMING_LANE_M, rng.uniform(25.0, 28.0), _TOWARDS, across, turns)
    return ego, [leaving, crossing, _parked(rng, rng.uniform(15.0, 16.0), "left"), _parked(rng, 30.0, "right")]


_KINDS: tuple[Callable[[np.random.Generator], tuple[Drive, list[Drive]]], ...] = (
    _passing_parked,
    _turning,
    _overtaking,
    _pulling_out,
)
