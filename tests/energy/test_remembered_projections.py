"""A problem remembers what it has projected: only of tensors that nobody has changed, and not longer than it lives."""

from __future__ import annotations

import copy
import gc
import weakref

import pytest
import torch
from helpers.five_cars import begun_stage

from directshape_torch.energy.car_problem import CarProblem
from directshape_torch.energy.car_state import CarState


def begun() -> tuple[CarProblem, CarState]:
    problem, _, state = begun_stage()
    problem.prior = copy.deepcopy(problem.prior)  # others use it too
    return problem, state


@torch.no_grad()
def test_the_same_tensors_are_projected_once() -> None:
    problem, state = begun()
    assert problem.project(state) is problem.project(state)
    assert problem.term_costs(state) is problem.term_costs(state)
    assert problem.project(CarState(state.T_obj_cam, state.code.clone())) is not problem.project(state)


@torch.no_grad()
@pytest.mark.parametrize("what", ["state", "prior", "prior's tensor", "weights", "new weights"])
def test_what_was_changed_in_place_is_evaluated_anew(what: str) -> None:
    problem, state = begun()
    state = CarState(*(x.clone() for x in state))
    problem.term_weights = torch.ones(len(state.code), len(problem.terms), dtype=torch.float64)
    before = problem.cost(state)
    if what == "state":
        state.code.add_(0.5)
    elif what == "prior":
        problem.prior.mean += 0.1
    elif what == "prior's tensor":
        problem.prior.mean = problem.prior.mean + 0.1
    elif what == "weights":
        problem.term_weights *= 2
    else:
        problem.term_weights = 2 * problem.term_weights
    assert not torch.isclose(problem.cost(state), before, rtol=1e-6).any()


@torch.no_grad()
@pytest.mark.parametrize("what", ["prior's tensor", "spacing", "weights"])
def test_what_is_replaced_again_and_again_is_never_taken_for_what_was_there_before(what: str) -> None:
    """Memory that was given back is used again: an address is no name."""
    problem, state = begun()
    spacing, mean = problem.prior.spacing_m, problem.prior.mean
    seen = set()
    for number in range(1, 13):
        if what == "prior's tensor":
            problem.prior.mean = mean + 0.01 * number
        elif what == "spacing":
            problem.prior.spacing_m = spacing * (1 + 0.01 * number)
        else:
            problem.term_weights = torch.full((5, len(problem.terms)), float(number), dtype=torch.float64)
        seen.add(float(problem.cost(state).sum()))
    assert len(seen) == 12


def test_inference_tensors_are_not_remembered() -> None:
    problem, state = begun()
    with torch.inference_mode():
        inferred = CarState(*(x.clone() for x in state))
        assert problem.project(inferred) is not problem.project(inferred)
        torch.testing.assert_close(problem.cost(inferred), problem.cost(state))


@torch.no_grad()
def test_projections_die_with_their_problem() -> None:
    problem, state = begun()
    projected = problem.project(state)
    projected.left.march, projected.right.march  # noqa: B018
    seen = weakref.ref(projected)
    gc.disable()
    try:
        del problem, projected
        assert seen() is None
    finally:
        gc.enable()


def test_forward_mode_sees_every_term_though_gradients_are_off() -> None:
    """With what is remembered of the same tensors there already."""
    problem, state = begun()
    tangent = CarState(torch.zeros_like(state.T_obj_cam), torch.full_like(state.code, 0.1))
    tangent.T_obj_cam[:, :3, 3] = 0.01
    inputs = tuple(x.clone().requires_grad_() for x in state)
    terms = problem.term_costs(CarState(*inputs)).sum(dim=0)
    gradients = [torch.autograd.grad(cost, inputs, retain_graph=True) for cost in terms]
    expected = [sum((g * t).sum() for g, t in zip(of_term, tangent, strict=True)) for of_term in gradients]
    with torch.no_grad():
        before = problem.term_costs(state)
        values, found = torch.func.jvp(lambda *x: problem.term_costs(CarState(*x)), tuple(state), tuple(tangent))
        assert problem.term_costs(state) is before
    torch.testing.assert_close(values, before, rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(found.sum(dim=0), torch.stack(expected), rtol=1e-6, atol=1e-9)
    assert (found.sum(dim=0) != 0).sum() >= 3


@torch.no_grad()
def test_nothing_is_remembered_of_a_transform() -> None:
    problem, state = begun()
    problem.project(state)
    known = list(problem._projections)
    shifts = 0.01 * torch.arange(2.0, dtype=state.code.dtype)
    torch.func.vmap(lambda shift: problem.project(CarState(state.T_obj_cam, state.code + shift)).shape.values)(shifts)
    assert problem._projections == known
