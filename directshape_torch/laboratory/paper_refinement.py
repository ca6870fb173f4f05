"""Whole refinements with the paper's depth derivative: the same energy, the same starts, only the steps differ."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.config import RefinerConfig, SamplingConfig, SolverConfig, StageConfig
from directshape_torch.energy.car_state import CarState
from directshape_torch.energy.photometric_term import PhotometricTerm
from directshape_torch.energy.projected_state import ProjectedState
from directshape_torch.energy.term import ResidualRows, Term, TermLinearisation
from directshape_torch.geometry import se3
from directshape_torch.laboratory.paper_depth import PAPER, row_factors
from directshape_torch.laboratory.regimes import REGIMES, DrawnStates, seeded
from directshape_torch.laboratory.scenes import LaboratoryScene
from directshape_torch.laboratory.steps import largest, median
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.residuals.photometric import DSO_PATTERN
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.solver.gauss_newton import Minimum, minimise
from directshape_torch.status import Status

CONTROL = "damped, control"

# Costs that differ by less are the same minimum, found to different digits.
_SAME_COST = 1e-3


@dataclass(frozen=True)
class PaperDepthTerm:
    """The photometric term with rows by `d depth / d sdf = -1 / cos(theta)`; its cost is the exact term's."""

    exact: PhotometricTerm

    @property
    def name(self) -> str:
        return self.exact.name

    def at_stage(self, stage: StageConfig, projected: ProjectedState) -> PaperDepthTerm:
        return PaperDepthTerm(self.exact.at_stage(stage, projected))

    def of_objects(self, keep: Tensor) -> PaperDepthTerm:
        return PaperDepthTerm(self.exact.of_objects(keep))

    def cost(self, projected: ProjectedState) -> Tensor:
        return self.exact.cost(projected)

    def residuals(self, projected: ProjectedState) -> ResidualRows:
        return self.exact.residuals(projected)

    def jacobian(self, projected: ProjectedState) -> Tensor:
        fixed = self.exact.fixed
        assert fixed is not None
        rays, root = projected.left.surface(fixed.pixel_index)
        gradient = projected.shape.value_and_derivatives(rays.at(root.depth), rays.object_index).gradient
        factor = row_factors(gradient, rays.direction_obj)[PAPER].repeat_interleave(len(DSO_PATTERN))
        return self.exact.jacobian(projected) * factor[:, None]

    def accumulate(self, rows: ResidualRows, J: Tensor, with_fisher: bool = False) -> TermLinearisation:
        return self.exact.accumulate(rows, J, with_fisher)

    def linearise(self, projected: ProjectedState, with_fisher: bool = False) -> TermLinearisation:
        return self.accumulate(self.residuals(projected), self.jacobian(projected), with_fisher)


@dataclass(frozen=True)
class PaperRefinement:
    """Refinements of the same cars from the same starts with the exact and with the paper's depth derivative.

    Attributes:
        solver: "damped" (as by default, but with marched rays and a cost tolerance of 1e-4) or "undamped" (pure
            Gauss-Newton, every step accepted, as in the paper);
            `CONTROL` compares the exact derivative with itself under twice the initial damping: how far apart two ways
            end that differ in nothing but their steps.
        cars: refined both ways.
        converged_exact, converged_paper: how many.
        iterations_exact, iterations_paper: mean per car.
        cost_higher, cost_lower: cars whose final cost is higher and lower by a thousandth with the paper's derivative.
        apart_m_median, apart_m, apart_deg_median, apart_deg: distance of the two final poses.
    """

    solver: str
    cars: int
    converged_exact: int
    converged_paper: int
    iterations_exact: float
    iterations_paper: float
    cost_higher: int
    cost_lower: int
    apart_m_median: float
    apart_m: float
    apart_deg_median: float
    apart_deg: float


@torch.no_grad()
def paper_refinements(
    scene: LaboratoryScene, prior: PCAShapePrior, num_states: int, seed: int = 0
) -> list[PaperRefinement]:
    """Refine the cars of a scene from disturbed detections, with both derivatives and both solvers."""
    # Marched: one of the two terms could not be followed, and nothing but the steps may differ.
    config = RefinerConfig(
        # Plain steps and pixels of both rounds, as in the paper.
        stages=(StageConfig(2.0, 1, 10), StageConfig(0.5, 0, 12)),
        sampling=SamplingConfig(mode_right="as_left"),
        solver=SolverConfig(rays="marched", cost_tolerance=1e-4),
    )
    undamped = replace(config, solver=replace(config.solver, initial_damping=0.0, accept_every_step=True))
    twice = replace(config, solver=replace(config.solver, initial_damping=2 * config.solver.initial_damping))
    regime = REGIMES["typical"]
    drawn = regime.draw(scene, prior, num_states, seeded(seed, regime))
    exact, paper, control, exact_undamped, paper_undamped = (
        _refine(scene, prior, drawn, settings, with_paper)
        for settings, with_paper in (
            (config, False),
            (config, True),
            (twice, False),
            (undamped, False),
            (undamped, True),
        )
    )
    return [
        _compare("damped", exact, paper),
        _compare(CONTROL, exact, control),
        _compare("undamped", exact_undamped, paper_undamped),
    ]


class _Refined(NamedTuple):
    minimum: Minimum[CarState]
    cost: Tensor  # (B,) in the last stage begun at the input state: one and the same function for all ways


def _refine(
    scene: LaboratoryScene, prior: PCAShapePrior, drawn: DrawnStates, config: RefinerConfig, with_paper: bool
) -> _Refined:
    start = CarState(drawn.state.T_obj_cam, torch.zeros_like(drawn.state.code))
    problem, initial = DirectShapeRefiner(prior, config).problem(scene.frame, drawn.detections)
    if with_paper:
        problem.terms = [_with_paper_depth(term) for term in problem.terms]
    minimum = minimise(problem, initial, config.solver, start)
    problem.begin_stage(problem.stages()[-1], initial)
    return _Refined(minimum, problem.cost(minimum.state))


def _compare(name: str, first: _Refined, second: _Refined) -> PaperRefinement:
    exact, paper = first.minimum, second.minimum
    costs = first.cost, second.cost
    difference = se3.to_kornia(paper.state.T_obj_cam @ se3.inverse(exact.state.T_obj_cam)).log()
    metres, degrees = difference[:, :3].norm(dim=1), torch.rad2deg(difference[:, 3:].norm(dim=1))
    converged = [int((m.status == Status.converged.code).sum()) for m in (exact, paper)]
    return PaperRefinement(
        name, len(metres), converged[0], converged[1],
        float(exact.iterations.double().mean()), float(paper.iterations.double().mean()),
        int((costs[1] > costs[0] * (1 + _SAME_COST)).sum()), int((costs[1] < costs[0] * (1 - _SAME_COST)).sum()),
        median(metres), largest(metres), median(degrees), largest(degrees),
    )  # fmt: skip


def _with_paper_depth(term: Term) -> Term:
    return PaperDepthTerm(term) if isinstance(term, PhotometricTerm) else term
