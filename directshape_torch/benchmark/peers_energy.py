"""The energy of cars as residuals and weighted robust norms: what a solver of another library is given to minimise.

It is the energy as it is defined, `CarProblem.cost`: every ray is marched anew at every state. Following the rays from
iteration to iteration (`solver.rays: tracked`) is our own solver's way to evaluate nearly the same sums in a fraction
of the time; a library that asks for residuals at any state it likes cannot be given it. By default our solver
therefore runs as it is shipped, tracked, and all final costs, its own too, are those of the marched energy; the suite
`peers` has our solver with marched rays as a row of its own, so that both parts of a ratio can be told apart.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.energy.car_problem import CarProblem
from directshape_torch.energy.car_state import CarState, retract
from directshape_torch.energy.photometric_term import PhotometricTerm
from directshape_torch.energy.prior_terms import PriorTerm
from directshape_torch.energy.projected_state import ProjectedState
from directshape_torch.energy.silhouette_term import SilhouetteTerm
from directshape_torch.energy.term import ResidualRows, Term
from directshape_torch.errors import InputError

# Corner of a Huber norm that is nothing but r^2 / 2; its square is finite in float64.
_QUADRATIC = 1e100
# Corner that stands for the norm r itself.
_IDENTITY = 0.0
# Of a residual whose norm is r; the silhouette's never come near it, for the foreground's probability is clamped.
_RESIDUAL_FLOOR = 1e-6


class WeightedNorms(NamedTuple):
    """What turns residuals into costs: a residual r costs `weight * rho(r)`.

    One formula serves all terms, so that a library is given one vector of residuals: rho is Huber's norm, with an
    endless corner for the priors; where the corner is 0 it is r itself (silhouette). As functions of r^2, for so both
    libraries want their robust norms ("kernel", "loss"), and such that halves of sums are costs.
    """

    weight: Tensor  # (..., R) float64
    corner: Tensor  # (..., R) float64

    def of_squares(self, squared: Tensor) -> Tensor:
        """Twice the weighted norm (..., R) of residuals given by their squares.

        Example:
            >>> corner = torch.tensor([0.0, 2.0, 1e100], dtype=torch.float64)
            >>> norms = WeightedNorms(torch.tensor([1.0, 1.0, 3.0], dtype=torch.float64), corner)
            >>> norms.of_squares(torch.full((3,), 16.0, dtype=torch.float64)) / 2
            tensor([ 4.,  6., 24.], dtype=torch.float64)
        """
        root = squared.clamp_min(_RESIDUAL_FLOOR**2).sqrt()
        linear = torch.where(self.corner == _IDENTITY, 2 * root, self.corner * (2 * root - self.corner))
        return self.weight * torch.where(squared <= self.corner**2, squared, linear)

    def slope_of_squares(self, squared: Tensor) -> Tensor:
        """Derivative (..., R) of `of_squares`: the weight of iteratively reweighted least squares."""
        root = squared.clamp_min(_RESIDUAL_FLOOR**2).sqrt()
        linear = torch.where(self.corner == _IDENTITY, torch.ones_like(root), self.corner) / root
        return self.weight * torch.where(squared <= self.corner**2, torch.ones_like(root), linear)


class _TermNorm(NamedTuple):
    """A term, the corner of its norm, and what stands for a residual that is not usable (None: its own value)."""

    term: Term
    corner: float
    lost: float | None


class _Evaluated(NamedTuple):
    state: CarState
    projected: ProjectedState
    residuals: Tensor


class CarEnergy:
    """The energy of a problem whose stage has begun, as one vector of residuals: the cost is that of `CarProblem.cost`.

    Residuals are float64, whatever precision they are computed in, so that the other library solves its systems in
    float64 as the own solver does. Those of the last two states are remembered: libraries ask again for the same
    state, for its cost, for its Jacobian, and after a step that they refused.

    Args:
        problem: B cars.
        state: any state of them.

    Attributes:
        object_index: (R,) car of each residual.
        norms: of the residuals (R,).
        seconds: spent here, by the clock.

    Raises:
        InputError: a term that is not a sum of weighted norms of its residuals, or whose norm is not known here.
    """

    def __init__(self, problem: CarProblem, state: CarState) -> None:
        self.problem = problem
        self.num_cars, self.num_codes = state.code.shape
        self.seconds = 0.0
        self._dtype = state.code.dtype
        self._terms = [_term_norm(term) for term in problem.terms]
        self._remembered: list[_Evaluated] = []
        with torch.no_grad():
            projected = problem.project(state)
            rows = [t.term.residuals(projected) for t in self._terms]
        self.object_index = torch.cat([r.object_index for r in rows])
        self.norms = _norms(self._terms, rows)

    def residuals(self, state: CarState) -> Tensor:
        """Residuals (R,) without derivatives."""
        return self._evaluate(state).residuals

    def differentiable_residuals(self, moved: CarState, at: CarState) -> Tensor:
        """The same for a state that carries derivatives and whose value is `at`.

        Samples, points of closest approach and hits are those of `at`, as in the own solver's Jacobians: nothing here
        depends on values, so that tangents can be batched.
        """
        frozen = self._evaluate(at).projected
        with self._clock():
            return self._collect(self.problem.project(self._cast(moved), frozen=frozen, root_iterations=0))

    def jacobian(self, at: CarState) -> Tensor:
        """Jacobian (R, D) by the tangent of `retract`, in forward mode.

        Each residual depends on one car only, so one tangent moves all cars at once: D tangents, batched.
        """

        def residuals_of(delta: Tensor) -> Tensor:
            return self.differentiable_residuals(retract(at, delta.expand(self.num_cars, -1)), at)

        zero = torch.zeros(6 + self.num_codes, dtype=at.code.dtype, device=at.code.device)
        jacobian: Tensor = torch.func.jacfwd(residuals_of)(zero)
        return jacobian

    def cost(self, state: CarState) -> Tensor:
        """Cost (B,), float64, as another library adds it up."""
        costs = 0.5 * self.norms.of_squares(self.residuals(state).square())
        return torch.zeros(self.num_cars, dtype=costs.dtype).to(costs).index_add(0, self.object_index, costs)

    def _evaluate(self, state: CarState) -> _Evaluated:
        for known in self._remembered:
            if all(torch.equal(a, b) for a, b in zip(known.state, state, strict=True)):
                return known
        with self._clock(), torch.no_grad():
            kept = CarState(*(x.detach().clone() for x in state))
            projected = self.problem.project(self._cast(kept))
            evaluated = _Evaluated(kept, projected, self._collect(projected))
        self._remembered = [evaluated, *self._remembered[:1]]
        return evaluated

    def _cast(self, state: CarState) -> CarState:
        return CarState(*(x.to(self._dtype) for x in state))

    def _collect(self, projected: ProjectedState) -> Tensor:
        return torch.cat([_values(t, projected) for t in self._terms]).to(torch.float64)

    @contextmanager
    def _clock(self) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds += time.perf_counter() - start


def _values(t: _TermNorm, projected: ProjectedState) -> Tensor:
    rows = t.term.residuals(projected)
    return rows.value if t.lost is None else torch.where(rows.usable, rows.value, t.lost)


def _norms(terms: Sequence[_TermNorm], rows: Sequence[ResidualRows]) -> WeightedNorms:
    weight = torch.cat([row_weights(t.term, r) for t, r in zip(terms, rows, strict=True)]).to(torch.float64)
    corner = [torch.full_like(r.value, t.corner, dtype=torch.float64) for t, r in zip(terms, rows, strict=True)]
    return WeightedNorms(weight, torch.cat(corner))


def _term_norm(term: Term) -> _TermNorm:
    if isinstance(term, SilhouetteTerm):
        return _TermNorm(term, _IDENTITY, None)
    if isinstance(term, PhotometricTerm) and not term.config.truncated:
        return _TermNorm(term, term.config.huber_grey_levels, term.config.lost_grey_levels)
    if isinstance(term, PriorTerm):
        return _TermNorm(term, _QUADRATIC, None)
    raise InputError(
        f"term {term.name!r}",
        "a silhouette, photometric (not truncated) or prior term, whose norms other libraries can be given",
        type(term).__name__,
        "compare with method 'direct' and photometric.truncated false",
    )


def row_weights(term: Term, rows: ResidualRows) -> Tensor:
    """The constant weight (R,) of each residual's norm, from the term's own sum.

    At residuals of 1 every norm has the slope 1, hence the slope of the summed cost there is the weight.
    """
    with torch.enable_grad():
        ones = torch.ones_like(rows.value).requires_grad_()
        probe = ResidualRows(ones, rows.object_index, torch.ones_like(rows.usable))
        cost = term.accumulate(probe, ones.new_zeros(len(ones), 1)).cost
        (weight,) = torch.autograd.grad(cost.sum(), ones)
    return weight
