"""This module presents the energy of B cars (E in the paper) to the solver, with its stages and iterations.

No object here keeps changing state: a prepared state, the stage that begins there and every evaluation are values that
are passed on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Any, TypeAlias, cast

import torch
from torch import Tensor

from directshape_torch.config import RefinerConfig, SolverConfig, StageConfig
from directshape_torch.numerics.gradient_mode import map_tensors
from directshape_torch.numerics.records import Dense
from directshape_torch.numerics.tables import Table
from directshape_torch.refinement.native_iterations import iterate_natively
from directshape_torch.rows import CarSums
from directshape_torch.shape.field import Field, field_of
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.solver.gauss_newton import Minimum
from directshape_torch.solver.problem import Done, Progress
from directshape_torch.solver.sharing import INDEPENDENT, Sharing
from directshape_torch.state.unknowns import LARGEST_ROTATION_RAD, AnyState, State, Unknowns
from directshape_torch.terms.depth import marched_views
from directshape_torch.terms.photometric import Photometric, PhotometricEvidence, Surface
from directshape_torch.terms.priors import with_joined_priors
from directshape_torch.terms.silhouette import MaskRows
from directshape_torch.terms.term import (
    AnyTerm,
    Evaluation,
    Evidence,
    Figures,
    Part,
    Prepared,
    by_autograd,
    linear_of,
    part_of,
    part_of_rows,
    parts_of,
    summed,
)


@dataclass(frozen=True)
class CarProblem(Table):
    """This `solver.Problem` minimises the sum of terms over pose and shape of B cars."""

    prior: ShapePrior  # the family of shapes
    evidence: tuple[Evidence, ...]  # what the summands of the energy are made of
    extra_terms: tuple[AnyTerm, ...]  # a user's own summands, whose columns come last
    masks: MaskRows  # the rays of both images, left ones first, used wherever rays are cast
    config: RefinerConfig  # stages, trust region, samples per ray
    # These factors (B, T) multiply the columns of costs of each car in addition to the weights of the terms. None
    # stands for 1.
    factors: Annotated[Tensor | None, Dense("B", "T")] = None
    sharing: Sharing = INDEPENDENT  # which cars share one shape

    @property
    def term_names(self) -> tuple[str, ...]:
        """Names of the T columns of costs."""
        return tuple(name for each in (*self.evidence, *self.extra_terms) for name in each.names)

    def stages(self) -> tuple[StageConfig, ...]:
        return self.config.stages

    @property
    def photometric(self) -> PhotometricEvidence | None:
        """The library's photometric evidence; None if it has no part in the energy."""
        found = next((each for each in self.evidence if "photometric" in each.names), None)
        return cast("PhotometricEvidence | None", found)

    def parts(
        self, terms: tuple[AnyTerm, ...], field: Field, state: State, anchors: tuple[object, ...], fisher: bool = True
    ) -> tuple[Part[Any], ...]:
        """What terms of the problem, for all or fewer cars, say of a state; `fisher` asks for the Fisher information.

        A user's terms are evaluated separately, so that they cannot disturb the function of the library's terms, which
        is compiled as a whole. They may mark their own functions `compile.compilable`.
        """
        own = len(terms) - len(self.extra_terms)
        extra = zip(terms[own:], anchors[own:], strict=True)
        of_extra = tuple(part_of(term, linear_of(term, self.prior, field, state, anchor)) for term, anchor in extra)
        return parts_of(terms[:own], field, state, anchors[:own], fisher) + of_extra

    def prepare(self, state: State) -> Prepared:
        """March every ray at a state: what rays see are constants, but state and field keep their graphs."""
        with torch.no_grad():
            field = field_of(self.prior.bind(state.code))
            bounds, num_samples = self.prior.bounds_obj, self.config.silhouette.samples_per_ray
            views = marched_views(*self.masks.of_sides, bounds, num_samples, field, state.T_obj_cam)
        return Prepared(state, field_of(self.prior.bind(state.code)) if torch.is_grad_enabled() else field, *views)

    def begin(self, stage: int, prepared: Prepared) -> CarStage:
        """The stage with number `stage`; it fixes at a state all that must stay constant while costs are compared."""
        stages = self.stages()
        config, earlier = stages[stage], stages[: range(len(stages))[stage]]
        after_wider = any(other.contour_width_px > config.contour_width_px for other in earlier)
        terms = tuple(each.begin(config, prepared) for each in (*self.evidence, *self.extra_terms))
        return CarStage(self, config, terms, after_wider, prepared.state.unknowns)


@dataclass(frozen=True)
class CarStage:
    """This is a stage that has begun."""

    problem: CarProblem  # of B cars
    config: StageConfig  # of the stage
    terms: tuple[AnyTerm, ...]  # with pixel sets, counts and widths fixed
    after_wider: bool  # an earlier stage had a wider contour
    unknowns: Unknowns  # of each car

    @property
    def photometric(self) -> Photometric | None:
        """The photometric term, which the disparity profile is made of."""
        return cast("Photometric | None", self.term("photometric"))

    def term(self, name: str) -> AnyTerm | None:
        """The library's term that fills the column `name`; None if it has no part in the energy."""
        own = self.terms[: len(self.problem.evidence)]
        return next((term for term in own if name in term.names), None)

    def photometric_part(self, figures: Figures) -> Part[Surface] | None:
        """What the photometric term says among the figures of a state."""
        return next((at for term, at in zip(self.terms, figures.parts, strict=True) if term is self.photometric), None)

    def information_of_measurements(self, figures: Figures) -> Tensor | None:
        """The Fisher matrix (B, D, D) of all terms except the priors; None if all terms are priors."""
        is_prior = [term.is_prior for term in self.terms for _ in term.names]
        seen = [part for part, prior in zip(figures.information.unbind(1), is_prior, strict=True) if not prior]
        return torch.stack(seen).sum(dim=0) if seen else None

    def figures(self, prepared: Prepared) -> Figures:
        """The energy of each column at a state, with every ray marched; differentiable if gradients are enabled."""
        anchors = tuple(term.anchor(prepared) for term in self.terms)
        parts = self.problem.parts(self.terms, prepared.field, prepared.state, anchors)
        layout = _Layout.of(self.terms, self.problem.factors)
        cells = CarSums.of(layout.owner * layout.num_columns + layout.column, layout.num_cars * layout.num_columns)
        cost, products = (torch.cat(x) for x in zip(*(part[:2] for part in parts), strict=True))
        information = torch.cat([part.information for part in parts])
        by_car = layout.num_cars, layout.num_columns

        def of_cells(table: Tensor, weight: Tensor) -> Tensor:
            return cells.sum(table, weight).view(*by_car, *table.shape[1:])

        products = of_cells(products, layout.weight)
        return Figures(
            of_cells(cost, layout.weight),
            products[:, :, -1],
            products[:, :, :-1],
            of_cells(information, layout.information),
            parts,
        )

    def start(self, prepared: Prepared) -> tuple[CarIterations, Evaluation]:
        """The problem of the iterations, and the energy where they begin."""
        problem = self.problem
        # The marched energy is differentiated afterwards, so its minimum must be found. This holds under `no_grad` too,
        # so that evaluation and training give equal results.
        if problem.config.solver.rays == "marched" or problem.config.backward.mode != "none":
            terms, rest = self._iterated_terms(), None
            anchors = tuple(term.anchor(prepared) for term in terms)
        else:
            changing = [term.changing_rows(prepared, self.after_wider) for term in self._iterated_terms()]
            terms, anchors, costs = (tuple(x) for x in zip(*changing, strict=True))
            by_column = torch.cat(costs, dim=1)
            rest = (by_column if problem.factors is None else by_column * problem.factors).sum(dim=1)
        # Rays are marched again only where nothing is known to rest.
        masks = problem.masks if rest is None else None
        iterations = CarIterations(self, terms, rest, problem.factors, masks, problem.sharing)
        return iterations, iterations.evaluated(prepared.field, prepared.state, anchors)

    def _iterated_terms(self) -> tuple[AnyTerm, ...]:
        """The terms with the library's priors joined, if cars have no factors; a user's terms stay separate."""
        if self.problem.factors is not None:
            return self.terms
        own = len(self.problem.evidence)
        return (*with_joined_priors(self.terms[:own]), *self.terms[own:])

    def linearise_differentiably(self, state: State) -> Evaluation:
        """The hand-derived linearisation with an autograd graph to state, images, masks, prior and weights."""
        with torch.no_grad():
            prepared = self.problem.prepare(state)
            anchors = tuple(term.anchor(prepared) for term in self.terms)
        field, layout = field_of(self.problem.prior.bind(state.code)), _Layout.of(self.terms, self.problem.factors)
        parts = self.problem.parts(self.terms, field, state, anchors)
        return self.without_held(summed(layout.sums(), layout.weight, parts))

    def without_held(self, at: Evaluation) -> Evaluation:
        """The evaluation for the solver, in which a fixed unknown has gradient 0 and an uncoupled curvature of 1."""
        if self.config.unknowns == "both":
            return at
        moving = self.unknowns.moving(self.config.unknowns, at.gradient.device)
        identity = torch.eye(len(moving), dtype=at.hessian.dtype, device=at.hessian.device)
        hessian = torch.where(moving[:, None] & moving, at.hessian, identity)
        return at._replace(gradient=torch.where(moving, at.gradient, torch.zeros_like(at.gradient)), hessian=hessian)

    def free_unknowns(self, state: State) -> Tensor:
        free = self.unknowns.free(state, self.problem.config.solver.max_code)
        return free & self.unknowns.moving(self.config.unknowns, free.device)

    def retract(self, state: AnyState, step: Tensor) -> AnyState:
        return self.unknowns.retract(state, step, self.problem.config.solver.max_code)

    def step_limits(self) -> Tensor:
        return self.unknowns.largest_steps(self.problem.prior.origin.device)


@dataclass(frozen=True)
class _Layout:
    """This lists the blocks of all terms, one term after the other."""

    owner: Tensor  # (M,) car
    column: Tensor  # (M,) of the costs
    weight: Tensor  # (M,) float64
    information: Tensor  # (M,) float64
    num_blocks: list[int]  # of each term
    num_cars: int
    num_columns: int

    @classmethod
    def of(cls, terms: Sequence[AnyTerm], factors: Tensor | None) -> _Layout:
        owners = [term.blocks.owner for term in terms]
        owner = torch.cat(owners)
        first = [sum(len(term.names) for term in terms[:n]) for n in range(len(terms))]
        column = torch.cat([term.column + n for term, n in zip(terms, first, strict=True)])
        weight, information = (
            torch.cat(x) for x in zip(*((t.block_weight, t.information) for t in terms), strict=True)
        )
        if factors is not None:
            factor = factors.to(torch.float64)[owner, column]
            weight, information = weight * factor, information * factor
        num_columns = sum(len(term.names) for term in terms)
        num_blocks, num_cars = [len(owner) for owner in owners], len(terms[0].blocks.counts)
        return cls(owner, column, weight, information, num_blocks, num_cars, num_columns)

    def sums(self) -> CarSums:
        """Sums over the blocks of each car."""
        return CarSums.of(self.owner, self.num_cars)


@dataclass(frozen=True)
class CarIterations(Table):
    """These are the `solver.Iterations` of the cars of a stage."""

    stage: CarStage
    terms: tuple[AnyTerm, ...]  # with the rows that can still change
    rest: Annotated[Tensor | None, Dense("B")]  # cost of rows that cannot change; None if all rows are marched
    factors: Annotated[Tensor | None, Dense("B", "T")]  # see `CarProblem`; this also holds for `sharing`
    masks: MaskRows | None  # rays that are marched at every state; None if rays are tracked
    sharing: Sharing

    @cached_property
    def layout(self) -> _Layout:
        """The blocks of the terms."""
        return _Layout.of(self.terms, self.factors)

    @cached_property
    def _sums(self) -> CarSums:
        return self.layout.sums()

    def evaluate(self, state: State, near: Evaluation) -> Evaluation:
        """The energy at a state; the anchors of the terms come from the evaluation `near`."""
        problem = self.stage.problem
        if self.masks is not None:
            prepared = replace(problem, masks=self.masks).prepare(state)
            return self.evaluated(prepared.field, state, tuple(term.anchor(prepared) for term in self.terms))
        return self.evaluated(field_of(problem.prior.bind(state.code)), state, near.anchors)

    def evaluated(self, field: Field, state: State, anchors: tuple[object, ...]) -> Evaluation:
        """The energy at a state; the terms are evaluated near their anchors."""
        problem = self.stage.problem
        parts = problem.parts(self.terms, field, state, anchors, fisher=False)
        if problem.config.solver.jacobian == "autograd":
            anchors = tuple(part.anchor for part in parts)
            rows = by_autograd(self.terms, problem.prior, state, anchors)
            parts = tuple(part_of_rows(t, *r, anchor) for t, r, anchor in zip(self.terms, rows, anchors, strict=True))
        at = summed(self._sums, self.layout.weight, parts)
        cost = at.cost if self.rest is None else at.cost + self.rest
        return self.stage.without_held(at._replace(cost=cost))

    def all_at_once(
        self,
        progress: Progress[AnyState, Evaluation],
        stage: StageConfig,
        config: SolverConfig,
        limits: Tensor,
        record: bool,
    ) -> list[Done[AnyState]] | None:
        """All iterations of a stage, if each term has a native loop and cars share nothing; see `Iterations`."""
        problem = self.stage.problem
        is_tracked = self.masks is None and problem.config.solver.jacobian == "analytic"
        has_others = self.factors is not None or bool(problem.extra_terms)
        if not is_tracked or has_others or self.sharing is not INDEPENDENT:
            return None
        held = ~self.stage.unknowns.moving(stage.unknowns, limits.device)
        block_weights = self.layout.weight.split_with_sizes(self.layout.num_blocks)
        terms = tuple(zip(self.terms, progress.at_state.anchors, block_weights, strict=True))
        return iterate_natively(problem.prior, terms, self.rest, progress, stage, config, limits, held, record)

    def choose(self, accepted: Tensor, new: Evaluation, old: Evaluation) -> Evaluation:
        conditions = accepted, accepted[:, None], accepted[:, None, None]
        cost, gradient, hessian = (torch.where(*x) for x in zip(conditions, new[:3], old[:3], strict=True))

        of_blocks = accepted[self.layout.owner, None].split_with_sizes(self.layout.num_blocks)

        def chosen(accepted: Tensor, new: object, old: object) -> object:
            return map_tensors(lambda x, y: torch.where(accepted, x, y), new, old)

        return Evaluation(cost, gradient, hessian, tuple(map(chosen, of_blocks, new.anchors, old.anchors)))

    def retract(self, state: AnyState, step: Tensor) -> AnyState:
        max_code = self.stage.problem.config.solver.max_code
        return self.stage.unknowns.retract(state, step, max_code, LARGEST_ROTATION_RAD)


CarMinimum: TypeAlias = Minimum[AnyState, Prepared, Evaluation, Figures]
"""A `CarMinimum` is the result of minimising a `CarProblem`."""


def stage_of(minimum: CarMinimum[AnyState]) -> CarStage:
    """The last stage that has begun, of all cars."""
    assert isinstance(minimum.stage, CarStage)
    return minimum.stage
