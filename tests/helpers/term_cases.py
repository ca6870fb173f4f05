"""This module has states for checks of terms: typical, near, far, at the border, with a rotated right camera."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import torch

from directshape_torch.config import PointCloudConfig
from directshape_torch.geometry import se3
from directshape_torch.refinement.problem import CarStage
from directshape_torch.state.cars import CarState
from helpers.derivatives import moved, tangent_of
from helpers.ellipsoids import ellipsoid_prior
from helpers.problems import CONFIGS, DEFAULT, begun_stage, with_code
from helpers.synthetic_scene import Street, cached_street, disturbed, measured_street, street

GENERAL_RIGHT = se3.exp(torch.tensor([-0.53, -0.003, 0.004, 0.004, -0.01, 0.002], dtype=torch.float64))
# A corner that some of the residuals exceed, so that both branches of the norm count.
CLOUD = PointCloudConfig(weight=30.0, huber_m=0.03, min_points=20, max_points=200)
COMBINED = replace(DEFAULT, point_cloud=CLOUD)
ALL_CONFIGS = {**CONFIGS, "combined": COMBINED}


@lru_cache
def scene_of(regime: str) -> Street:
    """A scene, rendered once for all tests."""
    prior = ellipsoid_prior()
    if regime == "near":
        return street(prior, [(0.4, 1.65, 4.6)], [0.9], focal_px=90.0)
    if regime == "far":
        return street(prior, [(0.3, 1.65, 80.0)], [-0.4], focal_px=1400.0)
    if regime == "border":
        return street(prior, [(-3.2, 1.65, 7.0)], [0.7])
    if regime == "rotated_right_camera":
        return street(prior, [(0.2, 1.65, 9.0)], [2.0], T_right_cam=GENERAL_RIGHT)
    return cached_street()[1]


def case(regime: str = "typical", config: str = "default", stage: int = 1) -> tuple[CarStage, CarState]:
    """A stage begun at disturbed cars, and another state, tilted and with another shape."""
    scene = measured_street()[1] if config == "combined" else scene_of(regime)
    metres = 0.02 if regime == "far" else 0.08
    begun, state = begun_stage(
        ellipsoid_prior(), scene.frames, disturbed(scene.detections, metres, 0.03), ALL_CONFIGS[config], stage
    )
    tilt = torch.tensor([0.0, 0.02, 0.0, 0.02, 0.0, -0.03] + [0.0] * 3, dtype=torch.float64)
    state = moved(state, tilt.expand_as(tangent_of(state)))
    return begun, with_code(state, [3.0, -2.9, 2.8] if regime == "three_sigma" else [0.3, -0.2, 0.4])
