"""The energy where a stage has ended: the blocks of the stage against all terms marched and linearised one by one."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers.derivatives import moved, relative_error
from helpers.five_cars import begun_stage, step_of, with_solver
from helpers.problems import DEFAULT, MARCHED, NORMALISED, TRUNCATED
from torch import Tensor

from directshape_torch.benchmark.workloads import demo_scene
from directshape_torch.config import RefinerConfig
from directshape_torch.config_files import load_config
from directshape_torch.energy.car_problem import CarProblem
from directshape_torch.energy.car_state import CarState
from directshape_torch.energy.end_blocks import EndBlocks
from directshape_torch.energy.end_linearisation import EndLinearisation
from directshape_torch.energy.photometric_term import PhotometricTerm
from directshape_torch.energy.prior_terms import PriorTerm
from directshape_torch.energy.projected_state import ProjectedState
from directshape_torch.refiner import DirectShapeRefiner

IN_BLOCKS = {
    "default": DEFAULT,
    "truncated": TRUNCATED,
    "normalised": replace(NORMALISED, stages=DEFAULT.stages),
    "combined": replace(DEFAULT, method="combined"),
    "product": replace(DEFAULT, silhouette=replace(DEFAULT.silhouette, form="product")),
    "pose sigmas": replace(DEFAULT, priors=replace(DEFAULT.priors, pose_sigma_along_m=0.3, pose_sigma_yaw_deg=3.0)),
}
AUTOGRAD = with_solver(DEFAULT, jacobian="autograd")


def one_by_one(problem: CarProblem, state: CarState) -> EndLinearisation:
    return EndLinearisation.of_parts(problem.terms, problem.linearise_terms(state, with_fisher=True))


def differences(found: EndLinearisation, expected: EndLinearisation) -> dict[str, float]:
    """The largest of the cars, each relative to the largest entry of the car."""
    return {
        name: max(relative_error(x[b], y[b]) for b in range(len(y)))
        for name, x, y in zip(found._fields, found, expected, strict=True)
        if y is not None
    }


def ended(
    config: RefinerConfig, motion: float, weights: dict[str, Tensor] | None = None
) -> tuple[CarProblem, CarState]:
    """A problem whose last stage has begun, and a state some way from there: further on, pixels lose the car."""
    problem, _, state = begun_stage(config, 1, None, weights)
    return problem, moved(state, step_of(5, motion, 5 * motion))


@pytest.fixture
def of_blocks(monkeypatch: pytest.MonkeyPatch) -> list[EndLinearisation]:
    """All that blocks have said."""
    said: list[EndLinearisation] = []
    linearise = EndBlocks.linearise

    def noted(blocks: EndBlocks, projected: ProjectedState) -> EndLinearisation:
        said.append(linearise(blocks, projected))
        return said[-1]

    monkeypatch.setattr(EndBlocks, "linearise", noted)
    return said


@pytest.mark.parametrize("motion", [0.0, 0.01, 0.1])
@pytest.mark.parametrize("name", IN_BLOCKS)
def test_blocks_say_what_the_terms_do(name: str, motion: float, of_blocks: list[EndLinearisation]) -> None:
    with torch.no_grad():
        problem, state = ended(IN_BLOCKS[name], motion)
        found = problem.linearise_end(state)
        assert len(of_blocks) == 1
        worst = differences(found, one_by_one(problem, state))
    assert set(worst) == {"hessian", "fisher", "fisher_seen", "photometric_gradient"}
    assert max(worst.values()) < 1e-8, worst


@pytest.mark.parametrize("config", [MARCHED, AUTOGRAD])
def test_where_nothing_is_followed_terms_speak_for_themselves(config, of_blocks) -> None:
    with torch.no_grad():
        problem, state = ended(config, 0.01)
        worst = differences(problem.linearise_end(state), one_by_one(problem, state))
    assert worst.keys() == {"hessian", "fisher", "fisher_seen", "photometric_gradient"}
    assert not of_blocks


def test_they_do_where_something_is_to_be_differentiated(of_blocks) -> None:
    problem, state = ended(DEFAULT, 0.01)
    code = state.code.clone().requires_grad_()
    found = problem.linearise_end(CarState(state.T_obj_cam, code))
    assert not of_blocks
    assert found.hessian.requires_grad


def test_they_do_once_terms_or_factors_are_others(of_blocks) -> None:
    """Blocks know the terms with which the stage began, and nothing of what came after."""
    names = [term.name for term in begun_stage(DEFAULT)[0].terms]
    ones = {name: torch.ones(5, dtype=torch.float64) for name in names}
    with torch.no_grad():
        for change in ("terms", "factors", "factors in place"):
            problem, state = ended(DEFAULT, 0.01, ones)
            assert problem.term_weights is not None
            if change == "terms":
                problem.term_weights = None
                problem.terms = [term for term in problem.terms if term.name != "photometric"]
            elif change == "factors":
                problem.term_weights = 3 * problem.term_weights
            else:
                problem.term_weights *= 3
            found = problem.linearise_end(state)
            assert (found.photometric_gradient is None) == (change == "terms")
            assert max(differences(found, one_by_one(problem, state)).values()) < 1e-8, change
    assert not of_blocks


def test_blocks_say_it_in_single_precision_too() -> None:
    """On the bundled demo, where a refinement has ended."""
    seen: list[tuple[EndLinearisation, EndLinearisation]] = []
    linearise_end = CarProblem.linearise_end

    def noted(problem: CarProblem, state: CarState) -> EndLinearisation:
        seen.append((linearise_end(problem, state), one_by_one(problem, state)))
        return seen[-1][0]

    (loaded, *_) = demo_scene().frames
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(CarProblem, "linearise_end", noted)
        DirectShapeRefiner(config=load_config("default", ["compile=off"]))(loaded.frame, loaded.detections)
    ((found, expected),) = seen
    worst = differences(found, expected)
    gradient = worst.pop("photometric_gradient")
    assert 0 < max(worst.values()) < 3e-4, worst
    # A sum of large numbers of either sign.
    assert gradient < 2e-2


def test_far_on_some_pixels_have_no_surface_and_some_cannot_be_compared() -> None:
    """Or the comparison above would not see what becomes of them."""
    with torch.no_grad():
        problem, state = ended(DEFAULT, 0.1)
        (term,) = (term for term in problem.terms if isinstance(term, PhotometricTerm))
        projected = problem.project(state)
        _, root = projected.left.surface(term.pixel_set.pixel_index)
        usable = term.residuals(projected).usable.view(len(root.found), -1)[:, 0]
    assert 0.02 < float((~root.found).double().mean()) < 0.5
    assert 0.005 < float((root.found & ~usable).double().mean()) < 0.5


def test_factors_of_single_cars_count_in_everything() -> None:
    names = [term.name for term in begun_stage(DEFAULT)[0].terms]
    draws = torch.rand(len(names), 5, generator=torch.Generator().manual_seed(3), dtype=torch.float64) + 0.2
    with torch.no_grad():
        problem, state = ended(DEFAULT, 0.01, dict(zip(names, draws, strict=True)))
        found = problem.linearise_end(state)
        worst = differences(found, one_by_one(problem, state))
        plain = ended(DEFAULT, 0.01)[0].linearise_end(state)
    assert max(worst.values()) < 1e-8, worst
    assert min(differences(found, plain).values()) > 0.05


def test_by_autograd_a_state_can_be_linearised_again() -> None:
    """What a projection finds on demand outlived the transform inside which it was found."""
    with torch.no_grad():
        problem, state = ended(AUTOGRAD, 0.01)
        first, again = one_by_one(problem, state), one_by_one(problem, state)
        costs = problem.term_costs(state)
    assert costs.isfinite().all()
    assert torch.equal(first.fisher, again.fisher)


@pytest.mark.parametrize("kept", [["photometric"], ["silhouette_left", "shape"], ["height"], ["silhouette_right"]])
def test_some_of_the_terms(kept: list[str]) -> None:
    """What there is none of is None, in blocks as in terms."""
    with torch.no_grad():
        problem, _, state = begun_stage(DEFAULT)
        problem.terms = [term for term in problem.terms if term.name in kept]
        problem.begin_stage(problem.stages()[1], state)
        there = moved(state, step_of(5, 0.01, 0.05))
        found, expected = problem.linearise_end(there), one_by_one(problem, there)
    assert [x is None for x in found] == [x is None for x in expected]
    assert (found.photometric_gradient is None) == ("photometric" not in kept)
    assert (found.fisher_seen is None) == all(isinstance(term, PriorTerm) for term in problem.terms)
    assert max(differences(found, expected).values()) < 1e-8


def test_a_broken_car_leaves_the_others_alone() -> None:
    with torch.no_grad():
        problem, state = ended(DEFAULT, 0.01)
        whole = problem.linearise_end(state)
        T_obj_cam = state.T_obj_cam.clone()
        T_obj_cam[2] = torch.nan
        found = problem.linearise_end(CarState(T_obj_cam, state.code))
    others = torch.tensor([0, 1, 3, 4])
    for x, y in zip(found, whole, strict=True):
        assert x is not None
        assert y is not None
        assert torch.equal(x[others], y[others])
    assert found.fisher[2].isnan().any()


def test_what_the_iterations_have_left_behind_makes_no_difference() -> None:
    """Hits that were followed, and cars that have left: the figures are of the state that is asked for."""
    with torch.no_grad():
        problem, part, state = begun_stage(DEFAULT)
        there = moved(state, step_of(5, 0.01, 0.05))
        expected = problem.linearise_end(there)
        part.linearise(moved(state, step_of(5, 0.05, 0.2)))
        part.follow(torch.tensor([True, False, True, True, False]))
        part.compact(torch.tensor([True, False, True, False, True]), [0, 2, 4])
        again = problem.linearise_end(there)
    for x, y in zip(again, expected, strict=True):
        assert x is not None
        assert torch.equal(x, y)  # type: ignore[arg-type]
