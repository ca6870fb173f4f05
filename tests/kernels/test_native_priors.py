"""Native priors have the cost, gradient and matrix of tensor operations in double precision."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from helpers.single_precision import in_single

from directshape_torch.laboratory.bench import Bench
from directshape_torch.shape.field import field_of
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.terms.priors import CarPrior, with_joined_priors
from directshape_torch.terms.term import Part, in_all_columns, part_of

ALL_BUT_TILT = "shape", "height", "dimensions", "pose"


def joined(terms: list[CarPrior]) -> CarPrior:
    """The terms in one, with the settings of the last one and with a prior in single precision."""
    settings = {"prior": PCAShapePrior.load_bundled(), "config": terms[-1].config}
    (term,) = with_joined_priors([replace(each, **settings) for each in terms])
    assert isinstance(term, CarPrior)
    return term


def by_tensors(term: CarPrior, state: Any) -> Part[Any]:
    """In double precision, of the numbers that the loop gets in single precision."""
    field = field_of(PCAShapePrior.load_bundled().double().bind(state.code))
    return part_of(term, in_all_columns(term, state, term.linear(field, state, ())))


def check_same(native: Part[Any] | None, expected: Part[Any]) -> None:
    assert native is not None
    for found, true in zip(native[:3], expected[:3], strict=True):
        # Products are summed up in single precision by tensor operations.
        torch.testing.assert_close(found, true, rtol=2e-5, atol=2e-5 * float(true.abs().max()))


@torch.no_grad()
@pytest.mark.parametrize("tilt", ["normal", "cosine"])
def test_priors_are_those_of_tensor_operations_in_every_regime(bench: Bench, tilt: str) -> None:
    names = (*ALL_BUT_TILT, f"tilt_{tilt}")
    terms = [term for name in names if isinstance(term := bench.terms[name], CarPrior)]
    assert len(terms) == len(names)
    size = bench.num_unknowns
    state = bench.moved(0.05 * torch.cos(torch.arange(size, dtype=torch.float64)))
    single = in_single(state)
    field = field_of(PCAShapePrior.load_bundled().bind(single.code))
    # In single precision nothing is left of the cosine of a small tilt, so it is compared beside other priors.
    for some in (terms, *([term] for term in terms[:-1])):
        natively = joined([in_single(each) for each in some])
        check_same(natively.native_part(field, single, (), fisher=False), by_tensors(joined(some), state))


def test_another_family_of_shapes_takes_tensor_operations(typical: Bench) -> None:
    class Another(PCAShapePrior):
        pass

    prior, known = PCAShapePrior.load_bundled(), typical.terms["shape"]
    assert isinstance(known, CarPrior)
    single, state = in_single(known), in_single(typical.state)
    another = replace(single, prior=PCAShapePrior.load_bundled())
    another.prior.__class__ = Another
    with torch.no_grad():
        field = field_of(prior.bind(state.code))
        assert replace(single, prior=prior).native_part(field, state, (), fisher=False) is not None
        assert another.native_part(field, state, (), fisher=False) is None
