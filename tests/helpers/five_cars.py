"""This module has a batch of five cars in two frames of different sizes that hide each other, without symmetries."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import torch

from directshape_torch.config import RefinerConfig
from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import FrameBatch
from directshape_torch.shape.pca_prior import PCAShapePrior
from helpers.ellipsoids import ellipsoid_prior
from helpers.synthetic_scene import CAMERA_HEIGHT_M, disturbed, joined_detections, joined_frames, street


@lru_cache(maxsize=1)
def five_cars() -> tuple[PCAShapePrior, FrameBatch, Detections]:
    """The five cars with disturbed detections, rendered once for all tests in float64.

    The second and third car are partly behind the first, and the fifth is behind the fourth.
    """
    prior = ellipsoid_prior()
    code = torch.tensor([[0.8, -0.5, 0.6], [-0.7, 0.4, 0.5], [0.1, 0.9, -0.6]], dtype=torch.float64)
    y = CAMERA_HEIGHT_M
    first = street(prior, [(-1.3, y, 8.0), (1.9, y, 12.5), (-0.2, y, 14.0)], [0.5, -1.2, 1.4], code, (112, 84), 105.0)
    second = street(prior, [(0.6, y, 9.0), (-2.4, y, 11.0)], [-0.4, 2.6], code[:2], (96, 72), 100.0)
    frames = joined_frames([first.frames, second.frames])
    detections = joined_detections([first.detections, second.detections], (84, 112))
    return prior, frames, disturbed(detections)


def with_solver(config: RefinerConfig, **changes: object) -> RefinerConfig:
    """The settings with other values of the solver."""
    return replace(config, solver=replace(config.solver, **changes))  # type: ignore[arg-type]
