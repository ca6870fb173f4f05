"""This module presents the energy of B cars (E in the paper) to the solver, with its stages and iterations.

No object here keeps changing state: a look at a state, the stage that begins there and every evaluation are values that
are passed on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import cast

import torch
from torch import Tensor

from directshape_torch.compile import will_compile
from directshape_torch.config import RefinerConfig, StageConfig
from directshape_torch.numerics.gradient_mode import map_tensors
from directshape_torch.rows import CarSums, Rays
from directshape_torch.shape.field import Field, field_of
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.solver.sharing import INDEPENDENT, Sharing
from directshape_torch.state.unknowns import LARGEST_ROTATION_RAD, AnyState, State, Unknowns
from directshape_torch.terms.depth import marched_views
from directshape_torch.terms.photometric import Photometric
from directshape_torch.terms.priors import with_joined_priors
from directshape_torch.terms.silhouette import MaskRows
from directshape_torch.terms.term import (
    Evaluation,
    Evidence,
    Figures,
    Part,
    Sight,
    Term,
    Where,
    by_autograd,
    linear_of,
    part_of,
    part_of_rows,
    parts_of,
    summed,
    with_varying_blocks,
)


@dataclass(frozen=True)
class CarProblem:
    """This `solver.Problem` minimises the sum of terms over pose and shape of B cars."""

    prior: ShapePrior  # the family of shapes
    evidence: tuple[Evidence, ...]  # what the summands of the energy are made of
    extra_terms: tuple[Term, ...]  # a user's own summands, whose columns come last
    masks: MaskRows  # the rays of both images, left ones first, used by everything that looks at a state
    rays: tuple[Rays, Rays]  # the rays of the left image and the rays of the right image
    config: RefinerConfig  # stages, trust region, samples per ray
    # These factors (B, T) multiply the columns of costs of each car in addition to the weights of the terms. None
    # stands for 1.
    factors: Tensor | None = None
    sharing: Sharing = INDEPENDENT  # which cars share one shape

    @property
    def term_names(self) -> tuple[str, ...]:
        """Names of the T columns of costs."""
        return tuple(name for each in (*self.evidence, *self.extra_terms) for name in each.names)

    def stages(self) -> tuple[StageConfig, ...]:
        return self.config.stages

    def evidence_of(self, name: str) -> Evidence | None:
        """The library's evidence that fills the column `name`; None if it has no part in the energy."""
        return next((each for each in self.evidence if name in each.names), None)

    def parts(
        self, terms: tuple[Term, ...], field: Field, state: State, wheres: tuple[Where, ...], fisher: bool = True
    ) -> tuple[Part, ...]:
        """What terms of the problem, for all or fewer cars, say of a state; `fisher` asks for the Fisher information.

        The library's terms are evaluated in one function, which is compiled as a whole. A user's terms are evaluated
        separately, so that they cannot disturb the compiled function. They may mark their own functions
        `compile.compilable`.
        """
        own = len(terms) - len(self.extra_terms)
        extra = zip(terms[own:], wheres[own:], strict=True)
        of_extra = tuple(part_of(term, linear_of(term, field, state, where)) for term, where in extra)
        # Compiled code always computes the Fisher information, so that it has one form.
        return parts_of(terms[:own], field, state, wheres[:own], fisher or will_compile()) + of_extra

    def look(self, state: State) -> Sight:
        """March every ray at a state: what rays see are constants, but state and field keep their graphs."""
        with torch.no_grad():
            field = field_of(self.prior.bind(state.code))
            bounds, num_samples = self.prior.bounds_obj, self.config.silhouette.samples_per_ray
            views = marched_views(*self.rays, bounds, num_samples, field, state.T_obj_cam)
        return Sight(state, field_of(self.prior.bind(state.code)) if torch.is_grad_enabled() else field, *views)

    def begin(self, stage: int, sight: Sight) -> CarStage:
        """The stage with number `stage`; it fixes at a state all that must stay constant while costs are compared."""
        stages = self.stages()
        config, earlier = stages[stage], stages[: range(len(stages))[stage]]
        after_wider = any(other.contour_width_px > config.contour_width_px for other in earlier)
        terms = tuple(each.begin(config, sight) for each in (*self.evidence, *self.extra_terms))
        return CarStage(self, config, terms, after_wider, sight.state.unknowns)

    def of_problems(self, keep: Tensor) -> CarProblem:
        """The problem of the cars where `keep` (B,) holds."""
        numbers = keep.nonzero()[:, 0].tolist()
        masks = self.masks.of_cars(keep, numbers)
        evidence = tuple(each.of_cars(keep, numbers) for each in self.evidence)
        extra = tuple(term.of_cars(keep, numbers) for term in self.extra_terms)
        factors = None if self.factors is None else self.factors[keep]
        sharing = self.sharing.of_problems(numbers)
        return replace(
            self,
            evidence=evidence,
            extra_terms=extra,
            masks=masks,
            rays=masks.of_sides(),
            factors=factors,
            sharing=sharing,
        )


@dataclass(frozen=True)
class CarStage:
    """This is a stage that has begun."""

    problem: CarProblem  # of B cars
    config: StageConfig  # of the stage
    terms: tuple[Term, ...]  # with pixel sets, counts and widths fixed
    after_wider: bool  # an earlier stage had a wider contour
    unknowns: Unknowns  # of each car

    @property
    def photometric(self) -> Photometric | None:
        """The photometric term, which the disparity profile is made of."""
        return cast("Photometric | None", self.term("photometric"))

    def term(self, name: str) -> Term | None:
        """The library's term that fills the column `name`; None if it has no part in the energy."""
        own = self.terms[: len(self.problem.evidence)]
        return next((term for term in own if name in term.names), None)

    def photometric_part(self, figures: Figures) -> Part | None:
        """What the photometric term says among the figures of a state."""
        return next((at for term, at in zip(self.terms, figures.parts, strict=True) if term is self.photometric), None)

    @property
    def is_prior_column(self) -> list[bool]:
        """Which of the T columns of costs belong to priors."""
        return [term.is_prior for term in self.terms for _ in term.names]

    def information_of_measurements(self, figures: Figures) -> Tensor | None:
        """The Fisher matrix (B, D, D) of all terms except the priors; None if all terms are priors."""
        seen = [
            part for part, prior in zip(figures.information.unbind(1), self.is_prior_column, strict=True) if not prior
        ]
        return torch.stack(seen).sum(dim=0) if seen else None

    @cached_property
    def _constant_terms(self) -> tuple[Term, ...]:
        """The terms in the form of compiled code, in which they are constants; `terms` may be differentiated."""
        return tuple(with_varying_blocks(term) for term in self.terms)

    def figures(self, sight: Sight) -> Figures:
        """The energy of each column at a state, with every ray marched; differentiable if gradients are enabled."""
        terms = self.terms if torch.is_grad_enabled() else self._constant_terms
        wheres = tuple(term.where(sight) for term in terms)
        parts = self.problem.parts(terms, sight.field, sight.state, wheres)
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

    def start(self, sight: Sight) -> tuple[CarIterations, Evaluation]:
        """The problem of the iterations, and the energy where they begin."""
        problem = self.problem
        # The marched energy is differentiated afterwards, so its minimum must be found. This holds under `no_grad` too,
        # so that evaluation and training give equal results.
        if problem.config.solver.rays == "marched" or problem.config.backward.mode != "none":
            terms, rest = self._iterated_terms(), None
            wheres = tuple(term.where(sight) for term in terms)
        else:
            moving = [term.moving(sight, self.after_wider) for term in self._iterated_terms()]
            terms, wheres, costs = (tuple(x) for x in zip(*moving, strict=True))
            by_column = torch.cat(costs, dim=1)
            rest = (by_column if problem.factors is None else by_column * problem.factors).sum(dim=1)
        iterations = CarIterations.of(self, terms, rest, problem.factors, problem.masks, problem.sharing)
        return iterations, iterations.evaluated(sight.field, sight.state, wheres)

    def _iterated_terms(self) -> tuple[Term, ...]:
        """The terms with the library's priors joined, if cars have no factors; a user's terms stay separate.

        Compiled code does not join priors: it has one form for this and for `figures`, and separate priors cost nothing
        there.
        """
        if self.problem.factors is not None or will_compile():
            return self.terms
        own = len(self.problem.evidence)
        return (*with_joined_priors(self.terms[:own]), *self.terms[own:])

    def linearise_differentiably(self, state: State) -> Evaluation:
        """The hand-derived linearisation with an autograd graph to state, images, masks, prior and weights."""
        with torch.no_grad():
            sight = self.problem.look(state)
            wheres = tuple(term.where(sight) for term in self.terms)
        field, layout = field_of(self.problem.prior.bind(state.code)), _Layout.of(self.terms, self.problem.factors)
        parts = self.problem.parts(self.terms, field, state, wheres)
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
        """Unknowns (B, D) that are free: a bound or the stage may fix others."""
        free = self.unknowns.free(state, self.problem.config.solver.max_code)
        return free & self.unknowns.moving(self.config.unknowns, free.device)

    def retract(self, state: AnyState, step: Tensor) -> AnyState:
        """The state moved by tangent vectors (B, D)."""
        return self.unknowns.retract(state, step, self.problem.config.solver.max_code)

    def step_limits(self) -> Tensor:
        """Largest trusted step of each unknown, (D,) float64; not to be written to."""
        return self.unknowns.largest_steps(self.problem.prior.origin.device)


@dataclass(frozen=True)
class _Layout:
    """This lists the blocks of all terms, one term after the other."""

    owner: Tensor  # (M,) car
    column: Tensor  # (M,) of the costs
    weight: Tensor  # (M,) float64
    information: Tensor  # (M,) float64
    num_cars: int
    num_columns: int

    @classmethod
    def of(cls, terms: Sequence[Term], factors: Tensor | None) -> _Layout:
        owner = torch.cat([term.blocks.owner for term in terms])
        first = [sum(len(term.names) for term in terms[:n]) for n in range(len(terms))]
        column = torch.cat([term.column + n for term, n in zip(terms, first, strict=True)])
        weight, information = (
            torch.cat(x) for x in zip(*((t.block_weight, t.information) for t in terms), strict=True)
        )
        if factors is not None:
            factor = factors.to(torch.float64)[owner, column]
            weight, information = weight * factor, information * factor
        num_columns = sum(len(term.names) for term in terms)
        return cls(owner, column, weight, information, len(terms[0].blocks.counts), num_columns)

    def sums(self) -> CarSums:
        """Sums over the blocks of each car."""
        return CarSums.of(self.owner, self.num_cars)


@dataclass(frozen=True)
class CarIterations:
    """This `solver.StageProblem` holds the cars of a stage that still move."""

    stage: CarStage  # of all cars of the problem
    terms: tuple[Term, ...]  # of the B cars that still move, with the rows that can still change
    layout: _Layout  # of the blocks of these terms
    sums: CarSums  # over these blocks
    rest: Tensor | None  # (B,) cost of rows that cannot change; None if every row is marched at every state
    factors: Tensor | None  # see `CarProblem`; this also holds for `masks` and `sharing`
    masks: MaskRows
    sharing: Sharing

    @classmethod
    def of(
        cls,
        stage: CarStage,
        terms: tuple[Term, ...],
        rest: Tensor | None,
        factors: Tensor | None,
        masks: MaskRows,
        sharing: Sharing,
    ) -> CarIterations:
        layout, terms = _Layout.of(terms, factors), tuple(with_varying_blocks(term) for term in terms)
        return cls(stage, terms, layout, layout.sums(), rest, factors, masks, sharing)

    def evaluate(self, state: State, near: Evaluation) -> Evaluation:
        """The energy at a state; the terms look near the points of the evaluation `near`."""
        problem = self.stage.problem
        if self.rest is None:
            sight = replace(problem, masks=self.masks, rays=self.masks.of_sides()).look(state)
            return self.evaluated(sight.field, state, tuple(term.where(sight) for term in self.terms))
        return self.evaluated(field_of(problem.prior.bind(state.code)), state, near.wheres)

    def evaluated(self, field: Field, state: State, wheres: tuple[Where, ...]) -> Evaluation:
        """The energy at a state; the terms look near the points `wheres`."""
        problem, terms = self.stage.problem, self.terms
        parts = problem.parts(terms, field, state, wheres, fisher=False)
        if problem.config.solver.jacobian == "autograd":
            looked = [part.where for part in parts]
            rows = by_autograd(terms, problem.prior, state, looked)
            parts = tuple(part_of_rows(t, *r, where) for t, r, where in zip(terms, rows, looked, strict=True))
        at = summed(self.sums, self.layout.weight, parts)
        cost = at.cost if self.rest is None else at.cost + self.rest
        return self.stage.without_held(at._replace(cost=cost))

    def choose(self, accepted: Tensor, new: Evaluation, old: Evaluation) -> Evaluation:
        """Take the new evaluation of cars whose step was accepted (B,), and the old one of all others."""
        conditions = accepted, accepted[:, None], accepted[:, None, None]
        cost, gradient, hessian = (torch.where(*x) for x in zip(conditions, new[:3], old[:3], strict=True))

        def chosen(term: Term, new: Where, old: Where) -> Where:
            if isinstance(new, tuple) and not new:  # looks nowhere
                return new
            in_blocks = accepted[term.blocks.owner][:, None]
            return map_tensors(lambda x, y: torch.where(in_blocks, x, y), new, old)

        return Evaluation(cost, gradient, hessian, tuple(map(chosen, self.terms, new.wheres, old.wheres)))

    def retract(self, state: AnyState, step: Tensor) -> AnyState:
        """The state moved by tangent vectors (B, D) within the trust region."""
        max_code = self.stage.problem.config.solver.max_code
        return self.stage.unknowns.retract(state, step, max_code, LARGEST_ROTATION_RAD)

    def of_problems(self, keep: Tensor, numbers: Sequence[int], at: Evaluation) -> tuple[CarIterations, Evaluation]:
        """The iterations and the evaluation of the cars where `keep` (B,) holds; these cars have the `numbers`."""
        index = torch.nonzero_static(keep, size=len(numbers))[:, 0]

        def kept(term: Term, where: Where) -> Where:
            if isinstance(where, tuple) and not where:
                return where
            blocks = term.blocks.of_cars(keep, numbers)[1]
            return map_tensors(lambda x: x.index_select(-2, blocks), where)

        rest, factors = (None if x is None else x.index_select(0, index) for x in (self.rest, self.factors))
        masks = self.masks if self.rest is not None else self.masks.of_cars(keep, numbers)
        terms = tuple(term.of_cars(keep, numbers) for term in self.terms)
        cost, gradient, hessian = (x.index_select(0, index) for x in at[:3])
        iterations = CarIterations.of(self.stage, terms, rest, factors, masks, self.sharing.of_problems(numbers))
        return iterations, Evaluation(cost, gradient, hessian, tuple(map(kept, self.terms, at.wheres)))
