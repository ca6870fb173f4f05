"""The terms of the energy as subjects: all rows of all cars, differenced by the common tangent."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from directshape_torch.energy.autograd_jacobian import rows_by_autograd
from directshape_torch.energy.car_state import CarState
from directshape_torch.energy.projected_state import ProjectedState
from directshape_torch.energy.term import Term
from directshape_torch.laboratory.bench import ROOT_ITERATIONS, Bench
from directshape_torch.laboratory.differences import Probe
from directshape_torch.laboratory.kinks import relevant_samples, term_branches
from directshape_torch.laboratory.subjects import Experiment, Subject
from directshape_torch.shape.pca_prior import PCAShapePrior


@dataclass(frozen=True)
class _Precisely:
    """Some terms of a bench over states whose surfaces are found as precisely as the dtype allows."""

    bench: Bench
    terms: Sequence[Term]

    def project(
        self, state: CarState, *, frozen: ProjectedState | None = None, root_iterations: int = ROOT_ITERATIONS
    ) -> ProjectedState:
        return self.bench.problem.project(state, frozen=frozen, root_iterations=root_iterations)


def term_experiment(bench: Bench, names: Sequence[str]) -> Experiment:
    """The named terms of a bench, each with its hand-derived and its autograd Jacobian by twist and code."""
    terms = [bench.terms[name] for name in names]
    prior = bench.problem.prior
    assert isinstance(prior, PCAShapePrior)
    by_autograd = rows_by_autograd(_Precisely(bench, terms), bench.state)
    relevant = [relevant_samples(term, bench.projected) for term in terms]

    def evaluate(delta: Tensor) -> list[Probe]:
        projected = bench.project(bench.moved(delta))
        probes = []
        for term, samples in zip(terms, relevant, strict=True):
            rows = term.residuals(projected)
            probes.append(Probe(rows.value, term_branches(term, prior, projected, rows, samples)))
        return probes

    with torch.no_grad():
        subjects = tuple(
            Subject(name, term.jacobian(bench.projected), J, rows.usable)
            for name, term, (rows, J) in zip(names, terms, by_autograd, strict=True)
        )
    return Experiment(subjects, torch.no_grad()(evaluate), torch.ones(bench.num_unknowns, dtype=bench.state.code.dtype))
