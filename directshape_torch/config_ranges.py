"""Which values of the settings make sense; anything else is an error that names the key."""

from __future__ import annotations

import dataclasses
import math
import typing
from functools import lru_cache
from typing import Any

from directshape_torch.errors import ConfigError

_TINY = 1e-300
_POSITIVE = (_TINY, math.inf)
_NOT_NEGATIVE = (0.0, math.inf)

# Lowest and highest allowed value of each number; in a tuple of numbers, of each entry.
_RANGES: dict[str, tuple[float, float]] = {
    "contour_width_px": _POSITIVE,
    "image_level": (0, 8),
    "max_iterations": _NOT_NEGATIVE,
    # Of 2 and more no quadratic energy would fall.
    "over_relaxation": (1, 1.99),
    "solver.initial_damping": _NOT_NEGATIVE,
    "solver.damping_decrease": (_TINY, 1),
    "solver.damping_increase": (1, math.inf),
    "solver.min_damping": _NOT_NEGATIVE,
    "solver.max_damping": _POSITIVE,
    "solver.cost_tolerance": _NOT_NEGATIVE,
    "solver.step_tolerance": _NOT_NEGATIVE,
    "solver.block_iterations": (1, math.inf),
    "solver.max_step_translation_m": _POSITIVE,
    "solver.max_step_rotation_rad": _POSITIVE,
    "solver.max_step_code": _POSITIVE,
    "solver.max_code": _POSITIVE,
    "silhouette.weight": _NOT_NEGATIVE,
    "silhouette.samples_per_ray": (1, 4096),
    "silhouette.probability_floor": (1e-6, 0.49),
    "silhouette.residual_floor": _POSITIVE,
    "silhouette.min_zeta_per_m": _POSITIVE,
    "silhouette.max_zeta_per_m": _POSITIVE,
    "silhouette.saturation": _POSITIVE,
    "photometric.weight": _NOT_NEGATIVE,
    "photometric.huber_grey_levels": _POSITIVE,
    "photometric.gradient_constant_grey_levels": _POSITIVE,
    "photometric.lost_grey_levels": _POSITIVE,
    "photometric.min_ray_cosine": (0, 0.999),
    "photometric.contrast_floor_grey_levels": (1e-3, math.inf),
    "point_cloud.weight": _NOT_NEGATIVE,
    "point_cloud.combined_weight": _NOT_NEGATIVE,
    "point_cloud.huber_m": _POSITIVE,
    "point_cloud.min_height_m": (-100, 100),
    "point_cloud.max_height_m": (-100, 100),
    "point_cloud.max_distance_m": _POSITIVE,
    "point_cloud.min_points": _NOT_NEGATIVE,
    "point_cloud.max_points": (1, math.inf),
    "point_cloud.rounds": (1, 1000),
    "point_cloud.max_iterations": (1, math.inf),
    "rig.disparity_sigma_px": _NOT_NEGATIVE,
    "priors.shape_weight": _NOT_NEGATIVE,
    "priors.height_weight": _NOT_NEGATIVE,
    "priors.tilt_weight": _NOT_NEGATIVE,
    "priors.dimensions_weight": _NOT_NEGATIVE,
    "priors.dimensions_sigma_m": _POSITIVE,
    "priors.pose_weight": _NOT_NEGATIVE,
    "priors.pose_sigma_along_share": _NOT_NEGATIVE,
    "priors.pose_sigma_along_m": _NOT_NEGATIVE,
    "priors.pose_sigma_across_m": _NOT_NEGATIVE,
    "priors.pose_sigma_vertical_m": _NOT_NEGATIVE,
    "priors.pose_sigma_yaw_deg": _NOT_NEGATIVE,
    "sampling.density": (_TINY, 1),
    "sampling.min_pixels": (1, math.inf),
    "sampling.max_pixels": (1, math.inf),
    "sampling.region_margin_px": _NOT_NEGATIVE,
    "sampling.region_margin_share": _NOT_NEGATIVE,
    "sampling.min_usable_pixels": _NOT_NEGATIVE,
    "search.disparity_offsets_px": (-100, 100),
    "search.yaw_offsets_deg": (-360, 360),
    "acceptance.min_probability_better": (0, 1),
    "acceptance.min_probability_not_worse": (0, 1),
    "backward.unroll_iterations": (1, math.inf),
    "backward.max_remaining_step": _POSITIVE,
}


def check_ranges(config: Any) -> None:
    """Raise `ConfigError` naming the first setting of a `RefinerConfig` that is out of range or no known word.

    Example:
        >>> from directshape_torch.config import RefinerConfig
        >>> check_ranges(RefinerConfig())
    """
    if not config.stages:
        raise ConfigError("stages: expected at least one stage, got none")
    _check_words(config)
    for i, stage in enumerate(config.stages):
        for key in ("contour_width_px", "image_level", "max_iterations", "over_relaxation"):
            _check(f"stages[{i}].{key}", getattr(stage, key), *_RANGES[key])
    for path, (low, high) in _RANGES.items():
        group, _, key = path.partition(".")
        if key:
            _check(path, getattr(getattr(config, group), key), low, high)
    _check_last_stage(config)
    for path, low_value, high_value in (
        ("silhouette.max_zeta_per_m", config.silhouette.min_zeta_per_m, config.silhouette.max_zeta_per_m),
        ("point_cloud.max_height_m", config.point_cloud.min_height_m, config.point_cloud.max_height_m),
        ("point_cloud.max_points", config.point_cloud.min_points, config.point_cloud.max_points),
        ("sampling.max_pixels", config.sampling.min_pixels, config.sampling.max_pixels),
        ("solver.max_damping", config.solver.min_damping, config.solver.max_damping),
    ):
        if low_value > high_value:
            raise ConfigError(f"{path}: expected at least {path.replace('max', 'min')} = {low_value}, got {high_value}")


def _check_words(config: Any, where: str = "") -> None:
    """Dataclasses made in Python take any word where a file is read against the hints."""
    choices = _choices(type(config))  # type: ignore[arg-type]  # mypy: the hash of a class is no method
    for field in dataclasses.fields(config):
        value, path = getattr(config, field.name), f"{where}{field.name}"
        if field.name in choices and value not in choices[field.name]:
            raise ConfigError(f"{path}: expected one of {', '.join(map(str, choices[field.name]))}, got {value!r}")
        for i, item in enumerate(value if isinstance(value, tuple) else (value,)):
            if dataclasses.is_dataclass(item):
                _check_words(item, f"{path}[{i}]." if isinstance(value, tuple) else f"{path}.")


@lru_cache
def _choices(kind: type) -> dict[str, tuple[Any, ...]]:
    """The words of each field of a dataclass that takes certain words only."""
    hints = typing.get_type_hints(kind)
    return {key: typing.get_args(hint) for key, hint in hints.items() if typing.get_origin(hint) is typing.Literal}


def _check_last_stage(config: Any) -> None:
    """Implicit gradients are those of the final stage, where pose and shape must both have come to rest."""
    key, value, needed = "stages[-1].unknowns", config.stages[-1].unknowns, "both"
    if config.method == "geometric":
        key, value, needed = "point_cloud.order", config.point_cloud.order, "joint"
    if config.backward.mode.startswith("implicit") and value != needed:
        raise ConfigError(f"{key}: backward.mode {config.backward.mode} needs {needed}, got {value}")


def _check(path: str, value: Any, low: float, high: float) -> None:
    for number in value if isinstance(value, tuple) else (value,):
        if not low <= number <= high or math.isinf(number):
            raise ConfigError(f"{path}: expected {_words(low, high)}, got {value}")


def _words(low: float, high: float) -> str:
    lowest = "a number above 0" if low == _TINY else f"a number of at least {low:g}"
    return lowest if high == math.inf else f"{lowest} and at most {high:g}"
