"""Named regimes: which states the laboratory draws, and which of their pixels it looks at."""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from directshape_torch.config import AcceptanceConfig, RefinerConfig
from directshape_torch.errors import InputError
from directshape_torch.geometry import se3
from directshape_torch.geometry.box3d import pose_from_kitti
from directshape_torch.laboratory.scenes import LaboratoryScene, place_cars, select_detections
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.scene import Detections
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.terms.cars import CarState, retract

Pixels = Literal["sampled", "contour", "grazing", "grid_border"]


@dataclass(frozen=True)
class DrawnStates:
    """B states with the detections whose pixels they are judged by."""

    detections: Detections
    state: CarState


@dataclass(frozen=True)
class Regime:
    """How states are drawn.

    Attributes:
        name: of the regime.
        explanation: in a few words, for reports.
        draw: from scene, prior, number of states and generator.
        pixels: which pixels of the cars take part.
        stage: of the settings: 1 is the fine one, 0 has a softer contour and half the image resolution.
        occlusion: whether cars hide one another; cars that were placed each on its own must not.
    """

    name: str
    explanation: str
    draw: Callable[[LaboratoryScene, PCAShapePrior, int, torch.Generator], DrawnStates]
    pixels: Pixels = "sampled"
    stage: int = 1
    occlusion: bool = False


_GROUND_Y_M = 1.65


def _uniform(generator: torch.Generator, count: int, low: float, high: float) -> Tensor:
    return low + (high - low) * torch.rand(count, generator=generator, dtype=torch.float64)


def _disturbed(state: CarState, generator: torch.Generator, metres: float, degrees: float, sigma: float) -> CarState:
    """States moved and turned at random, codes with normal deviates added."""
    count, num_codes = state.code.shape
    delta = torch.randn(count, 6, generator=generator, dtype=torch.float64)
    delta = delta * torch.tensor([metres] * 3 + [math.radians(degrees)] * 3, dtype=torch.float64)
    change = sigma * torch.randn(count, num_codes, generator=generator, dtype=torch.float64)
    return retract(state, torch.cat([delta, change], dim=1), max_code=3.0)


def _cycled(detections: Detections, count: int) -> Detections:
    return select_detections(detections, torch.arange(count) % len(detections))


def _typical(scene: LaboratoryScene, prior: PCAShapePrior, count: int, generator: torch.Generator) -> DrawnStates:
    detections = _cycled(scene.detections, count)
    start = CarState.of(se3.inverse(detections.T_cam_obj), prior.initial_code(count))
    return DrawnStates(detections, _disturbed(start, generator, 0.15, 2.0, 0.8))


def _near_optimum(scene: LaboratoryScene, prior: PCAShapePrior, count: int, generator: torch.Generator) -> DrawnStates:
    # Wherever the optimum lies, whether its box is to be trusted is another question.
    every_result = replace(RefinerConfig(), acceptance=AcceptanceConfig(0.0, 0.0))
    result = DirectShapeRefiner(prior, every_result)(scene.frame, scene.detections)
    rows = torch.arange(count) % len(scene.detections)
    refined = CarState.of(se3.inverse(result.T_cam_obj[rows]), result.code[rows])
    return DrawnStates(_cycled(scene.detections, count), _disturbed(refined, generator, 0.01, 0.1, 0.05))


def _placed(
    scene: LaboratoryScene,
    prior: PCAShapePrior,
    generator: torch.Generator,
    x_m: Tensor,
    z_m: Tensor,
    yaw_rad: Tensor,
    code: Tensor | None = None,
    disturb: bool = True,
) -> DrawnStates:
    """Cars put somewhere, seen from states a little off."""
    count = len(x_m)
    T_cam_obj = pose_from_kitti(torch.stack([x_m, torch.full_like(x_m, _GROUND_Y_M), z_m], dim=-1), yaw_rad)
    if code is None:
        code = torch.randn(count, prior.num_codes, generator=generator, dtype=torch.float64).clamp(-3, 3)
    detections = place_cars(scene, prior, T_cam_obj, code)
    state = CarState.of(se3.inverse(T_cam_obj), code)
    if disturb:
        state = _disturbed(state, generator, 0.05, 1.0, 0.0)
    return DrawnStates(detections, state)


def _anywhere(generator: torch.Generator, count: int) -> tuple[Tensor, Tensor, Tensor]:
    z = _uniform(generator, count, 8, 25)
    return 0.3 * z * _uniform(generator, count, -1, 1), z, _uniform(generator, count, -math.pi, math.pi)


def _far(scene: LaboratoryScene, prior: PCAShapePrior, count: int, generator: torch.Generator) -> DrawnStates:
    x, yaw = _uniform(generator, count, -10, 10), _uniform(generator, count, -math.pi, math.pi)
    return _placed(scene, prior, generator, x, torch.full_like(x, 80.0), yaw)


def _near(scene: LaboratoryScene, prior: PCAShapePrior, count: int, generator: torch.Generator) -> DrawnStates:
    x, yaw = _uniform(generator, count, -0.8, 0.8), _uniform(generator, count, -0.3, 0.3)
    return _placed(scene, prior, generator, x, torch.full_like(x, 3.0), yaw)


def _cut(scene: LaboratoryScene, prior: PCAShapePrior, count: int, generator: torch.Generator) -> DrawnStates:
    """The middle of the car projects onto the left or right border of the image."""
    K, width = scene.frame.camera.K_left[0], float(scene.frame.sizes[0, 1])
    z = _uniform(generator, count, 7, 14)
    border = torch.where(torch.arange(count) % 2 == 0, 0.0, width - 1.0)
    x = (border - K[0, 2]) * z / K[0, 0]
    return _placed(scene, prior, generator, x, z, _uniform(generator, count, -math.pi, math.pi))


def _anywhere_placed(
    scene: LaboratoryScene, prior: PCAShapePrior, count: int, generator: torch.Generator
) -> DrawnStates:
    return _placed(scene, prior, generator, *_anywhere(generator, count))


def _with_offset(scene: LaboratoryScene, prior: PCAShapePrior, count: int, generator: torch.Generator) -> DrawnStates:
    drawn = _anywhere_placed(scene, prior, count, generator)
    detections = replace(drawn.detections, offset_sigma_px=torch.full((count,), 0.5, dtype=torch.float64))
    return DrawnStates(detections, drawn.state._replace(offset_px=_uniform(generator, count, -1, 1)[:, None]))


def _with_code(size: float) -> Callable[..., DrawnStates]:
    def draw(scene: LaboratoryScene, prior: PCAShapePrior, count: int, generator: torch.Generator) -> DrawnStates:
        sign = torch.randint(0, 2, (count, prior.num_codes), generator=generator) * 2 - 1
        place = _anywhere(generator, count)
        return _placed(scene, prior, generator, *place, code=size * sign.double())

    return draw


def _with_yaw(*yaws: float) -> Callable[..., DrawnStates]:
    """Exact rotations, with no disturbance: the states where closed forms divide by an angle or lose the axis."""

    def draw(scene: LaboratoryScene, prior: PCAShapePrior, count: int, generator: torch.Generator) -> DrawnStates:
        x, z, _ = _anywhere(generator, count)
        yaw = torch.tensor(yaws, dtype=torch.float64)[torch.arange(count) % len(yaws)]
        return _placed(scene, prior, generator, x, z, yaw, disturb=False)

    return draw


REGIMES: Mapping[str, Regime] = {
    r.name: r
    for r in (
        Regime("typical", "detections of the frame, off by 0.15 m, 2 deg, code N(0, 0.8)", _typical, occlusion=True),
        Regime("near_optimum", "refined states, off by 1 cm, 0.1 deg", _near_optimum, occlusion=True),
        Regime("far_80m", "80 m away", _far, stage=0),
        Regime("near_3m", "3 m away", _near),
        Regime("image_border", "cut in half by the left or right image border", _cut),
        Regime("grazing", "rays within 72 to 90 deg of the surface normal", _anywhere_placed, pixels="grazing"),
        Regime("contour", "pixels on the soft contour, zeta sdf within 3", _anywhere_placed, pixels="contour"),
        Regime("identity_rotation", "rotation the identity, and 1e-7 rad off", _with_yaw(0.0, 1e-7)),
        Regime("near_pi_rotation", "rotation by pi, and 1e-7 and 1e-3 rad less",
               _with_yaw(math.pi, math.pi - 1e-7, math.pi - 1e-3)),
        Regime("code_zero", "the mean shape", _with_code(0.0)),
        Regime("code_three_sigma", "all components of the code at +-3", _with_code(3.0)),
        Regime("grid_border", "points within a cell of the border of the shape's grid", _anywhere_placed,
               pixels="grid_border", stage=0),
        Regime("disparity_offset", "the rig's disparity off by an unknown of up to 1 px", _with_offset),
    )
}  # fmt: skip


def regimes_named(names: list[str] | None) -> list[Regime]:
    """The regimes of these names, all where None.

    Raises:
        InputError: an unknown name; lists the names.

    Examples:
        >>> [r.name for r in regimes_named(["far_80m"])]
        ['far_80m']
    """
    return [REGIMES[checked_name("regime", name, list(REGIMES))] for name in names or REGIMES]


def checked_name(what: str, name: str, known: list[str]) -> str:
    """The name itself if it is known.

    Raises:
        InputError: it is not; lists the names and says which is nearest.
    """
    if name not in known:
        nearest = difflib.get_close_matches(name, known, n=1, cutoff=0.0)[0]
        raise InputError(what, f"one of {', '.join(known)}", repr(name), f"the nearest is {nearest}")
    return name


def seeded(seed: int, regime: Regime) -> torch.Generator:
    """A generator of a regime of its own: what is drawn does not depend on which other regimes are."""
    return torch.Generator().manual_seed(seed * 1000 + list(REGIMES).index(regime.name))


__all__ = ["REGIMES", "DrawnStates", "Regime", "checked_name", "regimes_named", "seeded"]
