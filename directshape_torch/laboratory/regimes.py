"""This module defines named regimes: which states the laboratory draws, and which pixels it examines."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from directshape_torch.config import AcceptanceConfig, RefinerConfig, RigConfig
from directshape_torch.geometry import se3
from directshape_torch.geometry.box3d import pose_from_kitti
from directshape_torch.laboratory.scenes import LaboratoryScene, place_cars
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.scene.detections import Detections
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.state.cars import CarState
from directshape_torch.tracks.path import NUM_PATH
from directshape_torch.tracks.state import TrackState

Pixels = Literal["sampled", "contour", "grazing", "grid_border"]
_GROUND_Y_M = 1.65


class DrawnStates(NamedTuple):
    """These are B states with the detections whose pixels are examined."""

    detections: Detections
    state: CarState | TrackState


class Draw(NamedTuple):
    """This holds what states are drawn from, and the ways to draw them."""

    scene: LaboratoryScene
    prior: PCAShapePrior
    num_states: int
    generator: torch.Generator

    def uniform(self, low: float, high: float) -> Tensor:
        """One random number for each state."""
        return low + (high - low) * torch.rand(self.num_states, generator=self.generator, dtype=torch.float64)

    def yaw(self) -> Tensor:
        """One random heading for each state."""
        return self.uniform(-math.pi, math.pi)

    def disturbed(self, state: CarState, metres: float, degrees: float, sigma: float) -> CarState:
        """States moved and turned at random, with normal deviates added to their codes."""
        count, num_codes = state.code.shape
        delta = torch.randn(count, 6, generator=self.generator, dtype=torch.float64)
        delta = delta * torch.tensor([metres] * 3 + [math.radians(degrees)] * 3, dtype=torch.float64)
        change = sigma * torch.randn(count, num_codes, generator=self.generator, dtype=torch.float64)
        return state.unknowns.retract(state, torch.cat([delta, change], dim=1), max_code=3.0)

    def of_frame(self, T_cam_obj: Tensor, code: Tensor, metres: float, degrees: float, sigma: float) -> DrawnStates:
        """Repeated detections of the frame, at random states near the given poses and codes."""
        rows = torch.arange(self.num_states) % len(T_cam_obj)
        start = CarState.of(se3.inverse(T_cam_obj[rows]), code[rows])
        return DrawnStates(self.scene.detections.rows(rows), self.disturbed(start, metres, degrees, sigma))

    def placed(
        self, x_m: Tensor, z_m: Tensor, yaw_rad: Tensor, code: Tensor | None = None, disturb: bool = True
    ) -> DrawnStates:
        """Cars placed as given, with states that are slightly disturbed."""
        T_cam_obj = pose_from_kitti(torch.stack([x_m, torch.full_like(x_m, _GROUND_Y_M), z_m], dim=-1), yaw_rad)
        if code is None:
            size = (self.num_states, self.prior.num_codes)
            code = torch.randn(*size, generator=self.generator, dtype=torch.float64).clamp(-3, 3)
        detections = place_cars(self.scene, self.prior, T_cam_obj, code)
        state = CarState.of(se3.inverse(T_cam_obj), code)
        return DrawnStates(detections, self.disturbed(state, 0.05, 1.0, 0.0) if disturb else state)

    def anywhere(self) -> tuple[Tensor, Tensor, Tensor]:
        """Random x, z and heading, 8 to 25 m ahead."""
        z = self.uniform(8, 25)
        return 0.3 * z * self.uniform(-1, 1), z, self.yaw()


@dataclass(frozen=True)
class Regime:
    """This regime says how states are drawn and which pixels are examined."""

    name: str  # of the regime
    explanation: str  # in a few words, for reports
    draw: Callable[[Draw], DrawnStates]  # the states
    pixels: Pixels = "sampled"  # which pixels of the cars take part
    stage: int = 1  # of the settings: 1 is the fine stage, 0 has a softer contour and half the image resolution
    occlusion: bool = False  # whether cars hide one another; separately placed cars must not


def _typical(d: Draw) -> DrawnStates:
    detections = d.scene.detections
    return d.of_frame(detections.T_cam_obj, d.prior.initial_code(len(detections)), 0.15, 2.0, 0.8)


def _near_optimum(d: Draw) -> DrawnStates:
    # Every optimum is wanted, whether its box is to be trusted or not.
    plain = RefinerConfig()
    alone = replace(plain.priors, detector_weight=0.0)
    every_result = replace(plain, acceptance=AcceptanceConfig(0.0, 0.0), rig=RigConfig(0.0), priors=alone)
    result = DirectShapeRefiner(d.prior, every_result)(d.scene.frame, d.scene.detections)
    return d.of_frame(result.T_cam_obj, result.code, 0.01, 0.1, 0.05)


def _far(d: Draw) -> DrawnStates:
    x, yaw = d.uniform(-10, 10), d.yaw()
    return d.placed(x, torch.full_like(x, 80.0), yaw)


def _near(d: Draw) -> DrawnStates:
    x, yaw = d.uniform(-0.8, 0.8), d.uniform(-0.3, 0.3)
    return d.placed(x, torch.full_like(x, 3.0), yaw)


def _cut(d: Draw) -> DrawnStates:
    """States of cars whose middle projects onto the left or right border of the image."""
    K, width = d.scene.frame.camera.K_left[0], float(d.scene.frame.sizes[0, 1])
    z = d.uniform(7, 14)
    border = torch.where(torch.arange(d.num_states) % 2 == 0, 0.0, width - 1.0)
    return d.placed((border - K[0, 2]) * z / K[0, 0], z, d.yaw())


def _anywhere(d: Draw) -> DrawnStates:
    return d.placed(*d.anywhere())


def _with_offset(d: Draw) -> DrawnStates:
    drawn = _anywhere(d)
    detections = replace(drawn.detections, offset_sigma_px=torch.full((d.num_states,), 0.5, dtype=torch.float64))
    return DrawnStates(detections, drawn.state._replace(offset_px=d.uniform(-1, 1)[:, None]))


def _track(d: Draw) -> DrawnStates:
    """States of one car, each the next view of the previous state; the image content does not matter."""
    detections = d.scene.detections
    d = d._replace(num_states=max(2, d.num_states))  # one view has no path
    drawn = d.of_frame(detections.T_cam_obj[:1], d.prior.initial_code(1), 0.15, 2.0, 0.8)
    path = torch.randn(1, NUM_PATH, generator=d.generator, dtype=torch.float64).repeat(d.num_states, 1)
    alone = drawn.state
    return drawn._replace(state=TrackState(*alone[:3], path, alone.T_obj_cam.roll(-1, 0)[:, None]))


def _with_code(size: float) -> Callable[[Draw], DrawnStates]:
    def draw(d: Draw) -> DrawnStates:
        sign = torch.randint(0, 2, (d.num_states, d.prior.num_codes), generator=d.generator) * 2 - 1
        return d.placed(*d.anywhere(), code=size * sign.double())

    return draw


def _with_yaw(*yaws: float) -> Callable[[Draw], DrawnStates]:
    """Draw exact rotations without disturbance, where closed forms divide by an angle or lose the axis."""

    def draw(d: Draw) -> DrawnStates:
        x, z, _ = d.anywhere()
        yaw = torch.tensor(yaws, dtype=torch.float64)[torch.arange(d.num_states) % len(yaws)]
        return d.placed(x, z, yaw, disturb=False)

    return draw


REGIMES: Mapping[str, Regime] = {
    r.name: r
    for r in (
        Regime("typical", "detections of the frame, off by 0.15 m, 2 deg, code N(0, 0.8)", _typical, occlusion=True),
        Regime("near_optimum", "refined states, off by 1 cm, 0.1 deg", _near_optimum, occlusion=True),
        Regime("far_80m", "80 m away", _far, stage=0),
        Regime("near_3m", "3 m away", _near),
        Regime("image_border", "cut in half by the left or right image border", _cut),
        Regime("grazing", "rays within 72 to 90 deg of the surface normal", _anywhere, pixels="grazing"),
        Regime("contour", "pixels on the soft contour, zeta sdf within 3", _anywhere, pixels="contour"),
        Regime("identity_rotation", "rotation the identity, and 1e-7 rad off", _with_yaw(0.0, 1e-7)),
        Regime("near_pi_rotation", "rotation by pi, and 1e-7 and 1e-3 rad less",
               _with_yaw(math.pi, math.pi - 1e-7, math.pi - 1e-3)),
        Regime("code_zero", "the mean shape", _with_code(0.0)),
        Regime("code_three_sigma", "all components of the code at +-3", _with_code(3.0)),
        Regime("grid_border", "points within a cell of the border of the shape's grid", _anywhere,
               pixels="grid_border", stage=0),
        Regime("disparity_offset", "the rig's disparity off by an unknown of up to 1 px", _with_offset),
        Regime("track", "two or more views of one car, off by 0.15 m, 2 deg, code N(0, 0.8), with any path", _track),
    )
}  # fmt: skip


def seeded(seed: int, regime: Regime) -> torch.Generator:
    """A separate generator for a regime, so that its draws do not depend on other regimes."""
    return torch.Generator().manual_seed(seed * 1000 + list(REGIMES).index(regime.name))
