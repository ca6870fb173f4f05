"""B cars as a problem for the solver: a list of terms over shared projections."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from directshape_torch.config import RefinerConfig, StageConfig, Unknowns
from directshape_torch.energy.autograd_jacobian import rows_by_autograd
from directshape_torch.energy.car_state import CarState, retract
from directshape_torch.energy.end_blocks import EndBlocks
from directshape_torch.energy.end_linearisation import EndLinearisation
from directshape_torch.energy.method import method_stages
from directshape_torch.energy.projected_state import ROOT_ITERATIONS, ProjectedState
from directshape_torch.energy.stage_unknowns import moving_unknowns, step_limits, without_held
from directshape_torch.energy.term import Term, TermLinearisation, total_of, weighted
from directshape_torch.energy.tracked_energy import TrackedEnergy, are_tracked
from directshape_torch.energy.tracked_problem import TrackedProblem
from directshape_torch.energy.unchanged import Origin
from directshape_torch.observation.packing import PixelSamples
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.solver.problem import Linearisation, StageProblem

# Projections kept: of the input, of the present stage's first state, of the end.
_REMEMBERED = 3


class CarProblem:
    """The energy of B cars (paper, E): a `Problem[CarState]`.

    Args:
        prior: the family of shapes.
        terms: summands of the energy; objects that never change, their tensors neither.
        left: packed pixels of the left image whose rays the terms share.
        right: the same of the right image.
        config: stages, trust region, samples per ray.
        term_weights: (B, T) factors of the terms of each car, beside their own weights; None for 1.
        unknowns: which of them move, until a stage says otherwise.
    """

    def __init__(
        self,
        prior: ShapePrior,
        terms: Sequence[Term],
        left: PixelSamples,
        right: PixelSamples,
        config: RefinerConfig,
        term_weights: Tensor | None = None,
        unknowns: Unknowns = "both",
    ) -> None:
        self.prior = prior
        self.terms = list(terms)
        self.left, self.right = left, right
        self.config = config
        self.term_weights = term_weights
        self.unknowns = unknowns
        self._projections: list[tuple[Origin, ProjectedState]] = []
        self._costs: list[tuple[Origin, Tensor]] = []  # of the present stage
        self._end_blocks: EndBlocks | None = None  # of the present stage

    def stages(self) -> list[StageConfig]:
        return method_stages(self.config)

    def begin_stage(self, stage: StageConfig, state: CarState) -> StageProblem[CarState]:
        self.unknowns = stage.unknowns
        self._costs, self._end_blocks = [], None
        projected = self.project(state)
        self.terms = [term.at_stage(stage, projected) for term in self.terms]
        # What is differentiated afterwards is `linearise_differentiably`, so its root must be found.
        if self.config.solver.rays == "marched" or self.config.backward.mode != "none":
            return self
        energy = TrackedEnergy.of_terms(self.terms, projected, self.term_weights, self._follows_a_wider(stage))
        if self.config.solver.jacobian != "autograd":
            self._end_blocks = EndBlocks.of(self.terms, self.term_weights, energy)
        others = [number for number, tracked in enumerate(are_tracked(self.terms)) if not tracked]
        marched = self._of_terms(others) if others else None
        return TrackedProblem(self.prior, energy, marched, self.config.solver, self.unknowns)

    def _follows_a_wider(self, stage: StageConfig) -> bool:
        stages = self.stages()
        earlier = stages[: stages.index(stage)] if stage in stages else []
        return any(other.contour_width_px > stage.contour_width_px for other in earlier)

    def _of_terms(self, numbers: Sequence[int]) -> CarProblem:
        terms = [self.terms[number] for number in numbers]
        weights = None
        if self.term_weights is not None:
            # Column by column: a list of numbers would have to be sent to the device.
            weights = torch.stack([self.term_weights[:, number] for number in numbers], dim=1)
        return CarProblem(self.prior, terms, self.left, self.right, self.config, weights, self.unknowns)

    def follow(self, accepted: Tensor) -> None:
        """Nothing is followed: every state is evaluated by itself."""

    def project(
        self,
        state: CarState,
        *,
        frozen: ProjectedState | None = None,
        root_iterations: int = ROOT_ITERATIONS,
        moving_depths: bool = False,
    ) -> ProjectedState:
        """Everything that the terms share at a state; the options are those of `ProjectedState`.

        Without options the same state (the very tensors, unchanged) gives the same projection, with all that it has
        computed.
        """
        plain = frozen is None and root_iterations == ROOT_ITERATIONS and not moving_depths
        of_prior = [tensor for _, tensor in (*self.prior.named_buffers(), *self.prior.named_parameters())]
        modules = self.prior.modules() if isinstance(self.prior, torch.nn.Module) else ()
        spacings = [s for s in (getattr(module, "spacing_m", None) for module in modules) if isinstance(s, float)]
        origin = Origin.of([*state, *of_prior], numbers=spacings)
        if not plain or origin is None:
            return self._new_projection(state, frozen, root_iterations, moving_depths)
        for then, known in self._projections:
            if origin.is_same(then):
                return known
        projected = self._new_projection(state, None, ROOT_ITERATIONS, False)
        self._projections = [(origin, projected), *self._projections[: _REMEMBERED - 1]]
        return projected

    def _new_projection(
        self, state: CarState, frozen: ProjectedState | None, root_iterations: int, moving_depths: bool
    ) -> ProjectedState:
        return ProjectedState(
            self.prior,
            state,
            self.left,
            self.right,
            self.config.silhouette.samples_per_ray,
            frozen=frozen,
            root_iterations=root_iterations,
            moving_depths=moving_depths,
        )

    def cost(self, state: CarState) -> Tensor:
        return self.term_costs(state).sum(dim=1)

    def term_costs(self, state: CarState) -> Tensor:
        """Cost (B, T) of each term; differentiable by autograd."""
        projected = self.project(state)
        origin = Origin.of([] if self.term_weights is None else [self.term_weights], [projected, *self.terms])
        if origin is None:
            return self._new_costs(projected)
        for then, costs in self._costs:
            if origin.is_same(then):
                return costs
        costs = self._new_costs(projected)
        self._costs = [(origin, costs), *self._costs[:1]]
        return costs

    def _new_costs(self, projected: ProjectedState) -> Tensor:
        costs = torch.stack([term.cost(projected) for term in self.terms], dim=1)
        return costs if self.term_weights is None else costs * self.term_weights.to(torch.float64)

    def linearise(self, state: CarState) -> Linearisation:
        """See `StageProblem`; with every ray marched."""
        return self._without_held(total_of(self.linearise_terms(state)))

    def linearise_terms(self, state: CarState, with_fisher: bool = False) -> list[TermLinearisation]:
        """The linearisation of each term by itself."""
        if self.config.solver.jacobian == "autograd":
            rows = rows_by_autograd(self, state)
            parts = [t.accumulate(r, J, with_fisher) for t, (r, J) in zip(self.terms, rows, strict=True)]
            return self._weighted(parts)
        projected = self.project(state)
        return self._weighted([term.linearise(projected, with_fisher) for term in self.terms])

    def linearise_end(self, state: CarState) -> EndLinearisation:
        """What `linearise_terms` says with Fisher information, where a stage has ended.

        If the stage was followed, and nothing is to be differentiated, by its blocks (`EndBlocks`); else term by term.
        """
        blocks = self._end_blocks
        if blocks is None or not blocks.are_of(self.terms, self.term_weights):
            return EndLinearisation.of_parts(self.terms, self.linearise_terms(state, with_fisher=True))
        return blocks.linearise(self.project(state))

    def linearise_differentiably(self, state: CarState) -> Linearisation:
        """The hand-derived linearisation with an autograd graph to state, images, masks, prior and weights."""
        projected = self.project(state, moving_depths=True)
        return self._without_held(total_of(self._weighted([term.linearise(projected) for term in self.terms])))

    def free_unknowns(self, state: CarState) -> Tensor:
        """Unknowns (B, D) that no bound holds: a code component at its bound is a constant."""
        free_pose = torch.ones_like(state.T_obj_cam[:, 0, :1], dtype=torch.bool).expand(-1, 6)
        free = torch.cat([free_pose, state.code.abs() < self.config.solver.max_code], dim=1)
        return free & moving_unknowns(self.unknowns, state.code)

    def _without_held(self, at: Linearisation) -> Linearisation:
        return without_held(at, self.unknowns)

    def _weighted(self, parts: list[TermLinearisation]) -> list[TermLinearisation]:
        return weighted(parts, self.term_weights)

    def retract(self, state: CarState, step: Tensor) -> CarState:
        return retract(state, step, self.config.solver.max_code)

    def step_limits(self) -> Tensor:
        return step_limits(self.config.solver, self.prior.num_codes, self.left.uv.device)

    def compact(self, keep: Tensor, numbers: Sequence[int] | None = None) -> CarProblem:
        """The problem of the cars where `keep` (B,) holds."""
        return CarProblem(
            self.prior,
            [term.of_objects(keep) for term in self.terms],
            self.left.of_objects(keep),
            self.right.of_objects(keep),
            self.config,
            None if self.term_weights is None else self.term_weights[keep],
            self.unknowns,
        )
