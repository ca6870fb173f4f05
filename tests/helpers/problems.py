"""This module has refinement problems over the synthetic street, for settings that change the mathematics."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from directshape_torch.config import AcceptanceConfig, RefinerConfig, RigConfig, StageConfig
from directshape_torch.io.config_files import load_config
from directshape_torch.refinement.problem import CarStage
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import FrameBatch
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.state.cars import CarState
from directshape_torch.terms.photometric import Photometric, PhotometricEvidence
from directshape_torch.terms.photometric_rows import LeftPixels
from directshape_torch.terms.term import Figures

DEFAULT = RefinerConfig(
    stages=(StageConfig(2.0, 1, 6), StageConfig(0.5, 0, 8)),
)
DEFAULT = replace(
    DEFAULT,
    # With 32 samples a ray that crosses opposite faces of the small grid never has one exactly on a plane of nodes.
    silhouette=replace(DEFAULT.silhouette, samples_per_ray=32),
    # What the solver finds is to be seen as it is.
    priors=replace(DEFAULT.priors, dimensions_weight=1.0, detector_weight=0.0),
    # Of the few pixels that a toy covers evenly spaced ones leave out much of its contour.
    sampling=replace(DEFAULT.sampling, mode_right="adaptive"),
    # The model of trust knows full-size images of real cars.
    acceptance=AcceptanceConfig(min_probability_better=0.0, min_probability_not_worse=0.0),
    # Its cameras are exact.
    rig=RigConfig(disparity_sigma_px=0.0),
)
MARCHED = replace(DEFAULT, solver=replace(DEFAULT.solver, rays="marched"))
PAPER = replace(
    MARCHED,
    silhouette=replace(DEFAULT.silhouette, form="product"),
    photometric=replace(DEFAULT.photometric, pixel_set="hit", brightness="none"),
    priors=replace(DEFAULT.priors, tilt_form="cosine", tilt_weight=1e7, dimensions_weight=0.0),
    sampling=replace(DEFAULT.sampling, occlusion_order="box_bottom"),
)
CONFIGS = {"default": DEFAULT, "paper": PAPER}
# The point cloud and the priors alone.
GEOMETRIC = replace(
    DEFAULT,
    silhouette=replace(DEFAULT.silhouette, weight=0.0),
    photometric=replace(DEFAULT.photometric, weight=0.0),
    point_cloud=load_config("geometric").point_cloud,
    stages=load_config("geometric").stages,
)


def begun_stage(
    prior: PCAShapePrior,
    frames: FrameBatch,
    detections: Detections,
    config: RefinerConfig = DEFAULT,
    stage: int = 1,
) -> tuple[CarStage, CarState]:
    """A stage of the problem of these cars that has begun at the input state, and that state."""
    problem, state = DirectShapeRefiner(prior, config).problem(frames, detections)
    return problem.begin(stage, problem.prepare(state)), state


def figures_at(stage: CarStage, state: CarState) -> Figures:
    """The energy at a state, with all rays marched."""
    return stage.figures(stage.problem.prepare(state))


def photometric_of(stage: CarStage) -> Photometric:
    """The photometric term of a stage that has one."""
    assert stage.photometric is not None
    return stage.photometric


def left_of(stage: CarStage) -> LeftPixels:
    """The left pixels of the photometric term of a stage."""
    return next(each.left for each in stage.problem.evidence if isinstance(each, PhotometricEvidence))


def with_code(state: CarState, code: Any) -> CarState:
    """The state with another code for all cars."""
    values: Tensor = torch.as_tensor(code, dtype=state.code.dtype)
    return state._replace(code=values.expand_as(state.code).contiguous())
