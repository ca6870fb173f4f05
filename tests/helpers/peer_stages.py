"""Our own solver on the synthetic street, for comparisons with solvers of other libraries."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from directshape_torch.benchmark.peers_task import OwnSolver, StageTask, with_jacobian, with_marched_rays
from directshape_torch.refiner import DirectShapeRefiner
from helpers.problems import DEFAULT
from helpers.synthetic_scene import cached_street, disturbed


def street_solver(
    tasks: Sequence[StageTask] | None = None,
    jacobian: Literal["analytic", "autograd"] = "analytic",
    max_iterations: Sequence[int] | None = None,
    marched: bool = False,
) -> OwnSolver:
    """Prepared for two disturbed cars; with tasks its stages begin where theirs do."""
    prior, scene = cached_street()
    refiner = with_jacobian(DirectShapeRefiner(prior, DEFAULT), jacobian)
    refiner = with_marched_rays(refiner) if marched else refiner
    starts = None if tasks is None else [task.start for task in tasks]
    return OwnSolver(refiner, scene.frames, disturbed(scene.detections), starts, max_iterations)
