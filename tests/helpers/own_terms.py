"""This module has terms as a user writes them, and refinements with them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torch import Tensor

from directshape_torch.config import RefinerConfig
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.refinement.scene_problem import TermFactory
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.scene.detections import Detections
from directshape_torch.state.cars import CarBatch, CarState
from directshape_torch.state.unknowns import POSE
from directshape_torch.terms.priors import PriorResidual, PriorTerm, height_prior
from helpers.problems import DEFAULT
from helpers.synthetic_scene import cached_street, disturbed


def lower_by(metres: Tensor | float) -> Callable[[CarBatch, CarState], PriorResidual]:
    """The height prior for a ground that is lower by the given distance."""

    def residual(cars: CarBatch, state: CarState) -> PriorResidual:
        at = height_prior(cars, state)
        return at._replace(residual=at.residual - metres)

    return residual


def made(kind: type[PriorTerm] = PriorTerm, residual_of: Any = None, weight: float = 1e5) -> TermFactory:
    return lambda *scene: kind("user", weight, scene[2], residual_of or lower_by(0.1), 1, (POSE,))


def refine(
    *extra: TermFactory, config: RefinerConfig = DEFAULT, detections: Detections | None = None
) -> RefinementResult:
    prior, scene = cached_street()
    detections = disturbed(scene.detections) if detections is None else detections
    result: RefinementResult = DirectShapeRefiner(prior, config, extra)(scene.frames, detections)
    return result
