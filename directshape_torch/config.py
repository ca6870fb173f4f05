"""Each setting is defined once, by its type, default, description and allowed numbers; units are in the names.

Checks, files, `--set key=value` and `configs/default.yaml` with its comments all follow from the fields below.
"""

from __future__ import annotations

import math
import operator
import typing
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cache
from numbers import Real
from typing import Any, Literal, TypedDict, TypeVar, Unpack

from directshape_torch.errors import ConfigError

Unknowns = Literal["both", "pose", "shape"]
"""A stage moves these unknowns."""
SamplingMode = Literal["adaptive", "uniform", "dense"]
"""The mode says which pixels of its region a car gets."""
OcclusionOrder = Literal["depth", "box_bottom"]
"""The order says which of two instances is in front."""

_T = TypeVar("_T")
_COMPARISONS = {"above": operator.gt, "at_least": operator.ge, "at_most": operator.le}


class Limits(TypedDict, total=False):
    """`Limits` bound a number, or each entry of a tuple. A name stands for the value of a setting of the same group."""

    above: float
    at_least: float | str
    at_most: float


def setting(default: _T, description: str, **limits: Unpack[Limits]) -> _T:
    """The field of one setting: its default, what it and its words mean, and which numbers it may have."""
    value: _T = field(default=default, metadata={"description": description, "limits": limits})
    return value


def limits_in_words(limits: Mapping[str, float | str], group: Settings | None = None) -> str:
    """Limits in words, as "above 0 and at most 1"; with a group, settings that are limits come with their values.

    Examples:
        >>> limits_in_words({"at_least": "min_pixels"}, SamplingConfig())
        'at least min_pixels = 400'
    """

    def value(limit: float | str) -> str:
        return f"{limit} = {getattr(group, limit)}" if group and isinstance(limit, str) else f"{limit}"

    return " and ".join(f"{name.replace('_', ' ')} {value(limit)}" for name, limit in limits.items())


@dataclass(frozen=True)
class Settings:
    """`Settings` are a group of settings. A value that is not allowed raises a `ConfigError` that names the key."""

    @classmethod
    @cache
    def types(cls) -> dict[str, Any]:
        """The types of the settings by name."""
        return typing.get_type_hints(cls)

    def __post_init__(self) -> None:
        for each in fields(self):
            value, hint = getattr(self, each.name), self.types()[each.name]
            if typing.get_origin(hint) is Literal and value not in typing.get_args(hint):
                raise ConfigError(f"{each.name}: expected one of {', '.join(typing.get_args(hint))}, got {value!r}")
            limits, entries = each.metadata.get("limits"), value if isinstance(value, tuple) else (value,)
            if limits and not all(self._is_within(limits, number) for number in entries):
                words = limits_in_words(limits, self)
                raise ConfigError(f"{each.name}: expected a finite number, {words}, got {value!r}")

    def _is_within(self, limits: Mapping[str, float | str], number: Any) -> bool:
        if not isinstance(number, Real) or not math.isfinite(number):
            return False
        known = {name: getattr(self, limit) if isinstance(limit, str) else limit for name, limit in limits.items()}
        return all(_COMPARISONS[name](number, limit) for name, limit in known.items())


@dataclass(frozen=True)
class StageConfig(Settings):
    """One stage of several, coarse to fine. Within a stage pixels, counts and zeta are fixed, so that costs compare."""

    contour_width_px: float = setting(
        0.5, "softness of the projected contour; zeta = f / (z_input * contour_width_px)", above=0
    )
    image_level: int = setting(0, "pyramid level of the photometric term; 0 is full resolution", at_least=0, at_most=8)
    max_iterations: int = setting(20, "Gauss-Newton iterations at most", at_least=0)
    unknowns: Unknowns = setting(  # noqa: RUF009
        "both", 'which of them move: "both", "pose" or "shape"; the others are constants'
    )
    over_relaxation: float = setting(
        1.0,
        "length of a step, as a multiple of Gauss-Newton's; after a step that gained next to nothing the next one is "
        "plain (1, the paper's). Plain steps stop short of the minimum, for robust weights make the matrix "
        "overestimate the curvature",
        at_least=1,
        at_most=1.99,
    )


@dataclass(frozen=True)
class SolverConfig(Settings):
    """Damping, acceptance and convergence of the Gauss-Newton loop."""

    initial_damping: float = setting(1e-2, "Marquardt's mu at the start of a stage; 0 is pure Gauss-Newton", at_least=0)
    accept_every_step: bool = setting(False, "accept uphill steps too and return the best state seen (the paper's way)")
    cost_tolerance: float = setting(1e-3, "relative decrease of the cost below which a car has converged", at_least=0)
    step_tolerance: float = setting(
        1e-3, "largest step, as a share of the trust region, below which a car has converged", at_least=0
    )
    block_iterations: int = setting(4, "iterations between two looks at which cars go on", at_least=1)
    max_code: float = setting(3.0, "bound of |code|, in standard deviations", above=0)
    jacobian: Literal["analytic", "autograd"] = setting(
        "analytic",
        '"analytic" (hand-derived) or "autograd" (forward mode, several times slower): the same steps',
    )
    rays: Literal["tracked", "marched"] = setting(
        "tracked",
        '"tracked" (each ray goes on from its closest point and its surface of the iteration before) or "marched" '
        "(each ray is sampled anew at each state: the slow reference)",
    )


@dataclass(frozen=True)
class RigConfig(Settings):
    """What is known beforehand of the stereo rig."""

    disparity_sigma_px: float = setting(
        0.3,
        "standard deviation of an unknown offset of the disparity, one for each car, where neither a rig nor a "
        "disparity field nor the detections say what the cameras are off by; it weighs depth by disparity "
        "against the size of the silhouettes and the detector's depth; 0: cameras are exact, as of rendered images",
        at_least=0,
    )


@dataclass(frozen=True)
class BackwardConfig(Settings):
    """Gradients through the refinement, for training in front of it."""

    mode: Literal["none", "unroll", "implicit", "implicit_gauss_newton"] = setting(
        "none",
        '"none" (no graph), "unroll" (repeats the last iterations), "implicit" (implicit function theorem at the final '
        'stage) or "implicit_gauss_newton" (the same with the Gauss-Newton matrix: cheaper, biased)',
    )
    unroll_iterations: int = setting(
        1000,
        "how many of the last accepted steps are repeated at most; if steps are left out, the input pose has no "
        "gradient",
        at_least=1,
    )
    max_remaining_step: float = setting(
        0.001,
        "implicit modes: no gradient for cars whose next Newton step exceeds this share of the trust region",
        above=0,
    )


@dataclass(frozen=True)
class SilhouetteConfig(Settings):
    """Silhouette term, left and right."""

    weight: float = setting(12.0, "lambda_silh, factor of the term", at_least=0)
    form: Literal["closest_approach", "product"] = setting(
        "closest_approach", '"closest_approach" (default) or "product" (the paper\'s; it dilates the contour)'
    )
    samples_per_ray: int = setting(24, "coarse samples inside the prior's bounds", at_least=1, at_most=4096)
    probability_floor: float = setting(
        0.01, "foreground probabilities are clamped to [floor, 1 - floor]", at_least=1e-6, at_most=0.49
    )


@dataclass(frozen=True)
class PhotometricConfig(Settings):
    """Photometric term, left to right, in grey levels 0..255."""

    weight: float = setting(1.0, "factor of the term (the paper: 1)", at_least=0)
    huber_grey_levels: float = setting(9.0, "corner of the Huber norm (gamma)", above=0)
    lost_grey_levels: float = setting(
        15.0, "a pixel of the set that loses its hit or leaves the right image pays the Huber norm of this", above=0
    )
    pixel_set: Literal["hit", "hit_and_mask"] = setting(
        "hit_and_mask", '"hit" (the paper) or "hit_and_mask" (hit and p_fg > 0.5)'
    )
    brightness: Literal["none", "gain", "affine"] = setting(
        "gain",
        'how the brightness of the two images is matched, for each car at the start of each stage: "gain" (a factor), '
        '"affine" (a factor and an offset, for cameras of different black level or contrast) or "none" (the paper)',
    )


@dataclass(frozen=True)
class PointCloudConfig(Settings):
    """Point cloud from dense stereo (Engelmann et al., GCPR 2016), which the presets "geometric" and "combined" fit."""

    weight: float = setting(
        0.0,
        "factor of the mean Huber norm of the signed distances, per square metre; 0: no point cloud. Points alone need "
        "300, points beside the images 30",
        at_least=0,
    )
    huber_m: float = setting(0.1, "corner of the Huber norm", above=0)
    min_points: int = setting(
        200,
        "a car with fewer points is fitted to the images alone; without images it keeps its input (status "
        "too_few_points)",
        at_least=0,
    )
    max_points: int = setting(1000, "most points of a car: of more, every n-th is used", above=0, at_least="min_points")


@dataclass(frozen=True)
class PriorConfig(Settings):
    """Priors on shape and pose."""

    shape_weight: float = setting(0.15, "lambda_1, on the whitened code", at_least=0)
    height_weight: float = setting(
        10.0, "lambda_2, on the object origin's height above the ground plane in metres", at_least=0
    )
    tilt_weight: float = setting(1000.0, "lambda_3, on the tilt against the ground plane", at_least=0)
    tilt_form: Literal["normal", "cosine"] = setting(
        "normal",
        '"normal" (two components of the ground normal in the object frame) or "cosine" (the paper\'s, whose Jacobian '
        "vanishes at its optimum)",
    )
    dimensions_weight: float = setting(
        0.5,
        "weight of the difference between the shape's dimensions and the detector's, in units of dimensions_sigma_m; 0 "
        "switches it off (the paper)",
        at_least=0,
    )
    dimensions_sigma_m: tuple[float, float, float] = setting(
        (0.1, 0.1, 0.4), "standard deviation of the detector's height, width and length", above=0
    )
    detector_weight: float = setting(
        1.0,
        "weight of the detector's boxes against those of the images where a rig knows what both are off by (see "
        "docs/derivations/fusion.md); 0: the images' boxes alone, as for terms whose errors nobody measured",
        at_least=0,
    )
    pose_weight: float = setting(
        0.2,
        "weight of the detector's pose, in units of its standard deviations: those of the detections where they have "
        "some, else those below; without either it does nothing",
        at_least=0,
    )
    pose_sigma_along_share: float = setting(
        0.0,
        "standard deviation of the detector's position along the viewing ray on the ground, as a share of the distance "
        "(in this and the next four, 0 means not known)",
        at_least=0,
    )
    pose_sigma_along_m: float = setting(
        0.0, "a constant part of it in metres, added to the share in squares", at_least=0
    )
    pose_sigma_across_m: float = setting(
        0.0, "standard deviation of the detector's position across the viewing ray, on the ground", at_least=0
    )
    pose_sigma_vertical_m: float = setting(
        0.0, "standard deviation of the detector's position along the camera's y axis", at_least=0
    )
    pose_sigma_yaw_deg: float = setting(0.0, "standard deviation of the detector's heading", at_least=0)

    @property
    def pose_sigmas(self) -> tuple[float, float, float, float, float]:
        """Sigmas along the ray (share of distance, metres), across, vertical (metres), of yaw (radians); 0: unknown."""
        metres = self.pose_sigma_along_m, self.pose_sigma_across_m, self.pose_sigma_vertical_m
        return self.pose_sigma_along_share, *metres, math.radians(self.pose_sigma_yaw_deg)


@dataclass(frozen=True)
class TracksConfig(Settings):
    """How the frames of a tracked car belong together (docs/tracks.md)."""

    next_view_weight: float = setting(
        0.15,
        "factor of the left image against that of the next frame, warped through the car's surface; 0 switches it off",
        at_least=0,
    )
    path_sigma_m: float = setting(
        0.05,
        "standard deviation of a car's position on the ground about a smooth path, where the times of the frames are "
        "known; 0: no path",
        at_least=0,
    )
    path_sigma_yaw_deg: float = setting(1.0, "standard deviation of a car's heading about that path", above=0)
    acceleration_sigma_mps2: float = setting(
        1.0, "standard deviation of the acceleration of the path, along each axis, m/s^2", above=0
    )
    turn_acceleration_sigma_dps2: float = setting(
        20.0, "standard deviation of the change of its turn rate, deg/s^2", above=0
    )


@dataclass(frozen=True)
class SamplingConfig(Settings):
    """How many pixels a car gets, and which."""

    mode: SamplingMode = setting(  # noqa: RUF009
        "adaptive",
        'in the left image: of each small cell the pixel of the strongest gradient ("adaptive", the paper) or the one '
        'in the middle ("uniform"), or every pixel of the region ("dense")',
    )
    mode_right: SamplingMode = setting(  # noqa: RUF009
        "uniform", "in the right image, whose pixels serve the silhouette alone"
    )
    density: float = setting(0.05, "wanted pixels per pixel of the region", above=0, at_most=1)
    min_pixels: int = setting(400, "fewest wanted pixels; a region of fewer gives all it has", at_least=1)
    max_pixels: int = setting(1000, "most wanted pixels", at_least="min_pixels")
    occlusion_order: OcclusionOrder = setting(  # noqa: RUF009
        "depth", 'which instance is nearer: by "depth" (default) or "box_bottom" (the paper)'
    )
    min_usable_pixels: int = setting(20, "cars with fewer pixels get the status too_few_pixels", at_least=0)
    occlusion: bool = setting(True, "leave out pixels that a nearer instance hides")


@dataclass(frozen=True)
class AcceptanceConfig(Settings):
    """Which results are returned; the input stands in for the others (status not_trusted or no_car)."""

    min_probability_better: float = setting(
        0.5,
        'least probability that the BEV IoU rose (docs/results.md, "When to trust a result")',
        at_least=0,
        at_most=1,
    )
    min_probability_not_worse: float = setting(
        0.85,
        "least probability that it fell by at most 0.05; 0 for both: no result is refused for its probabilities",
        at_least=0,
        at_most=1,
    )


@dataclass(frozen=True)
class RefinerConfig(Settings):
    """Everything `DirectShapeRefiner` can be told."""

    compile: Literal["on", "off"] = setting(
        "off",
        "compile what native loops leave to tensor operations by torch.compile, for a graphics card "
        "(docs/performance.md); results differ in the last digits",
    )
    check: Literal["first", "always", "off"] = setting(
        "first",
        "look for common mistakes in images, calibration, masks and boxes (docs/check_data.md) in the first call of a "
        "refiner, in every call, or never; what is found is a Python warning, and results do not depend on it",
    )
    search: Literal["rescue", "always", "off"] = setting(
        "rescue",
        'find cars by their masks and disparity where the given box does not lead to them: "rescue" (cars that end '
        'refuted by the images, far from their box or beside their mask), "always" (every car whose '
        'mask leads out of the reach of its box) or "off"; it needs silhouettes and photometry, and leaves tracks '
        "alone",
    )
    stages: tuple[StageConfig, ...] = (
        StageConfig(contour_width_px=2.0, image_level=1, max_iterations=6, over_relaxation=1.6),
        StageConfig(contour_width_px=0.5, image_level=0, max_iterations=6, over_relaxation=1.6),
    )
    solver: SolverConfig = field(default_factory=SolverConfig)
    silhouette: SilhouetteConfig = field(default_factory=SilhouetteConfig)
    photometric: PhotometricConfig = field(default_factory=PhotometricConfig)
    point_cloud: PointCloudConfig = field(default_factory=PointCloudConfig)
    priors: PriorConfig = field(default_factory=PriorConfig)
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    rig: RigConfig = field(default_factory=RigConfig)
    tracks: TracksConfig = field(default_factory=TracksConfig)
    acceptance: AcceptanceConfig = field(default_factory=AcceptanceConfig)
    backward: BackwardConfig = field(default_factory=BackwardConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.stages:
            raise ConfigError("stages: expected at least one stage, got none")
        # Implicit gradients belong to the final stage, in which both pose and shape must have settled.
        if self.backward.mode.startswith("implicit") and self.stages[-1].unknowns != "both":
            value = self.stages[-1].unknowns
            raise ConfigError(f"stages[-1].unknowns: backward.mode {self.backward.mode} needs both, got {value}")

    @property
    def fits_images(self) -> bool:
        """Whether silhouettes or the photometric term take part."""
        return self.silhouette.weight > 0 or self.photometric.weight > 0

    @property
    def fits_points(self) -> bool:
        """Whether the point cloud of dense stereo takes part."""
        return self.point_cloud.weight > 0
