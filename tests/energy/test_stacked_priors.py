"""All priors at once against the priors one by one, in value, gradient and matrix, and against autograd."""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace

import pytest
import torch
from helpers.derivatives import moved, tangent_of
from helpers.host_traffic import host_traffic
from helpers.priors import KINDS, prior_of
from helpers.problems import CONFIGS
from torch import Tensor

from directshape_torch.config import PriorConfig, RefinerConfig
from directshape_torch.energy.car_batch import CarBatch
from directshape_torch.energy.car_state import CarState
from directshape_torch.energy.prior_terms import AtState, DimensionsResidual, PriorTerm, ShapeResidual, prior_terms
from directshape_torch.energy.stacked_priors import StackedPriors
from directshape_torch.energy.term import Term, TermLinearisation
from directshape_torch.errors import InputError
from directshape_torch.geometry import se3
from directshape_torch.residuals.priors import PriorResidual, shape_prior
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.shape.shape_prior import DimensionsDerivative

POSE = PriorConfig(pose_sigma_along_share=0.02, pose_sigma_vertical_m=0.3, pose_sigma_yaw_deg=4.0)
SETTINGS = {
    "default": CONFIGS["default"].priors,
    "paper": CONFIGS["paper"].priors,
    "pose": POSE,
    "all of them, of other weights": replace(
        POSE, shape_weight=0.3, height_weight=7.0, tilt_weight=11.0, dimensions_weight=0.7, pose_weight=0.2
    ),
    "only the shape": PriorConfig(height_weight=0.0, tilt_weight=0.0, dimensions_weight=0.0),
    "no shape": PriorConfig(shape_weight=0.0, dimensions_weight=0.0),
}


def _random(*shape: int, seed: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def _cars(count: int, sigma: bool = False) -> CarBatch:
    detector = se3.exp(torch.cat([_random(count, 3, seed=1), 0.5 * _random(count, 3, seed=2)], dim=1))
    detector[:, 2, 3] += 15.0
    normal = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64) + 0.05 * _random(count, 3, seed=3)
    eye = torch.eye(4, dtype=torch.float64).expand(count, 4, 4)
    return CarBatch(
        detection_row=torch.arange(count),
        frame_index=torch.zeros(count, dtype=torch.long),
        input_depth=detector[:, 2, 3],
        K_left=eye[:, :3, :3],
        K_right=eye[:, :3, :3],
        T_right_cam=eye,
        ground_normal_cam=torch.nn.functional.normalize(normal, dim=1),
        ground_offset=1.65 + 0.1 * _random(count, seed=4),
        detector_hwl=torch.tensor([1.5, 1.6, 4.2], dtype=torch.float64) + 0.2 * _random(count, 3, seed=5),
        detector_T_cam_obj=detector,
        detector_pose_sigma=0.05 + _random(count, 4, seed=6).abs() if sigma else None,
    )


def _state(cars: CarBatch, num_codes: int, size: float = 0.3) -> CarState:
    count = len(cars.input_depth)
    T = se3.exp(size * _random(count, 6, seed=7)) @ se3.inverse(cars.detector_T_cam_obj)
    return CarState(T, _random(count, num_codes, seed=8))


class _At:
    def __init__(self, state: CarState) -> None:
        self.state = state


def _one_by_one(terms: list[PriorTerm], state: CarState, factors: Tensor | None = None) -> TermLinearisation:
    """The sum of the terms, from their readable residuals and Jacobians."""
    count, unknowns = len(state.code), 6 + state.code.shape[1]
    cost, gradient, hessian = (torch.zeros(count, *shape).double() for shape in ((), (unknowns,), (unknowns, unknowns)))
    for i, term in enumerate(terms):
        r, J = term.residual_of(term.cars, _At(state))
        weight = term.weight * (torch.ones(count).double() if factors is None else factors[:, i])
        cost = cost + 0.5 * weight * (r * r).sum(dim=1)
        gradient = gradient + weight[:, None] * (J.mT @ r[..., None])[..., 0]
        hessian = hessian + weight[:, None, None] * (J.mT @ J)
    return TermLinearisation(cost, gradient, hessian, hessian)


def _terms(priors: PriorConfig, kind: str, cars: CarBatch) -> list[PriorTerm]:
    terms: list[Term] = prior_terms(replace(RefinerConfig(), priors=priors), prior_of(kind), cars)
    stackable = [term for term in terms if StackedPriors.takes(term)]
    assert len(stackable) == len(terms)
    return stackable


def linearised(stacked: StackedPriors, state: CarState) -> TermLinearisation:
    cost, products = stacked.parts(state)
    return TermLinearisation(cost, products[:, -1], products[:, :-1], products[:, :-1])


def _same(found: TermLinearisation, expected: TermLinearisation) -> None:
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12 * float(b.abs().max()) if b.numel() else 0.0)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", SETTINGS)
def test_equal_to_the_terms_by_themselves(name: str, kind: str) -> None:
    cars = _cars(4)
    terms = _terms(SETTINGS[name], kind, cars)
    num_codes = prior_of(kind).num_codes
    stacked = StackedPriors.from_terms(terms, num_codes)
    for size in (0.3, 1e-6):
        state = _state(cars, num_codes, size)
        _same(linearised(stacked, state), _one_by_one(terms, state))


def test_a_pose_that_has_lost_its_orthonormality_to_rounding_is_no_other() -> None:
    """As float32 leaves it after many steps; of every entry of the matrix the same use is made."""
    cars = _cars(3, sigma=True)
    terms = _terms(SETTINGS["pose"], "pca", cars)
    state = _state(cars, 3)
    drifted = CarState(state.T_obj_cam * (1 + 1e-4 * _random(3, 4, 4, seed=9)), state.code)
    drifted.T_obj_cam[:, 3] = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64)
    _same(linearised(StackedPriors.from_terms(terms, 3), drifted), _one_by_one(terms, drifted))


def test_sigmas_of_the_detections_and_factors_of_the_cars() -> None:
    cars = _cars(5, sigma=True)
    assert cars.detector_pose_sigma is not None
    cars.detector_pose_sigma[0] = torch.inf
    terms = _terms(SETTINGS["default"], "pca", cars)
    assert [term.name for term in terms][-1] == "pose"
    factors = _random(5, len(terms), seed=10).abs()
    factors[1, 2] = 0.0
    stacked = StackedPriors.from_terms(terms, 3, factors)
    state = _state(cars, 3)
    _same(linearised(stacked, state), _one_by_one(terms, state, factors))


@pytest.mark.parametrize("kind", ["pca", "neural"])
def test_the_gradient_is_that_of_the_cost(kind: str) -> None:
    cars = _cars(3, sigma=True)
    num_codes = prior_of(kind).num_codes
    stacked = StackedPriors.from_terms(_terms(SETTINGS["pose"], kind, cars), num_codes)
    state = _state(cars, num_codes)
    delta = tangent_of(state).requires_grad_()
    (expected,) = torch.autograd.grad(stacked.parts(moved(state, delta)).cost.sum(), delta)
    torch.testing.assert_close(linearised(stacked, state).gradient, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("kind", ["pca", "neural"])
def test_some_of_the_cars(kind: str) -> None:
    cars = _cars(4, sigma=True)
    num_codes = prior_of(kind).num_codes
    stacked = StackedPriors.from_terms(_terms(SETTINGS["pose"], kind, cars), num_codes)
    state = _state(cars, num_codes)
    keep = torch.tensor([True, False, False, True])
    whole, part = linearised(stacked, state), linearised(stacked.of_objects(keep), CarState(*(x[keep] for x in state)))
    for a, b in zip(part, whole, strict=True):
        torch.testing.assert_close(a, b[keep], rtol=1e-14, atol=1e-14)
    none = stacked.of_objects(torch.zeros(4, dtype=torch.bool))
    empty = linearised(none, CarState(state.T_obj_cam[:0], state.code[:0]))
    assert [x.shape for x in empty[:3]] == [(0,), (0, 6 + num_codes), (0, 6 + num_codes, 6 + num_codes)]


@pytest.mark.parametrize("kind", ["pca", "neural"])
def test_some_of_the_cars_without_a_question_where_their_number_is_known(kind: str) -> None:
    cars = _cars(4, sigma=True)
    stacked = StackedPriors.from_terms(_terms(SETTINGS["pose"], kind, cars), prior_of(kind).num_codes)
    keep = torch.tensor([True, False, False, True])
    parts: list[StackedPriors] = []
    assert host_traffic(lambda: parts.append(stacked.of_objects(keep, 2))).found == []
    # Otherwise once, however many constants there are.
    assert host_traffic(lambda: parts.append(stacked.of_objects(keep))).found == ["aten.nonzero"]
    state = _state(cars, prior_of(kind).num_codes)
    known, asked = (linearised(part, CarState(*(x[keep] for x in state))) for part in parts)
    for a, b in zip(known, asked, strict=True):
        assert torch.equal(a, b)


def test_a_broken_car_touches_no_other() -> None:
    cars = _cars(3, sigma=True)
    stacked = StackedPriors.from_terms(_terms(SETTINGS["pose"], "pca", cars), 3)
    state = _state(cars, 3)
    whole = linearised(stacked, state)
    state.T_obj_cam[1], state.code[1] = torch.nan, torch.inf
    broken = linearised(stacked, state)
    assert not broken.cost[1].isfinite()
    for a, b in zip(broken, whole, strict=True):
        assert torch.equal(a[[0, 2]], b[[0, 2]])


def test_single_precision_states_are_computed_with_in_double() -> None:
    cars = _cars(3, sigma=True)
    terms = _terms(SETTINGS["pose"], "pca", cars)
    stacked = StackedPriors.from_terms(terms, 3)
    single = CarState(*(x.float() for x in _state(cars, 3)))
    found = linearised(stacked, single)
    assert found.cost.dtype == found.hessian.dtype == torch.float64
    _same(found, _one_by_one(terms, CarState(*(x.double() for x in single))))


@pytest.mark.parametrize("kind", ["pca", "neural"])
def test_dimensions_in_single_precision_are_subtracted_in_double(kind: str) -> None:
    """The difference of the very numbers: a detector with more digits behind the point than a car's length has."""
    prior = copy.deepcopy(prior_of(kind)).float()
    cars = _cars(2)
    code = _random(2, prior.num_codes, seed=11).float()
    hwl = prior.dimensions_and_derivative(code).hwl
    cars = replace(cars, detector_hwl=0.3 + 0.01 * _random(2, 3, seed=12).float())
    term = PriorTerm("dimensions", 1.0, cars, DimensionsResidual(prior, (0.1, 0.1, 0.1)))
    stacked = StackedPriors.from_terms([term], prior.num_codes)
    found = stacked.parts(CarState(_state(cars, 1).T_obj_cam, code)).cost
    expected = 0.5 * (((hwl.double() - cars.detector_hwl.double()) / 0.1) ** 2).sum(dim=1)
    if kind == "pca":
        # Linear in the code: not even the dimensions are rounded.
        linear = prior.dimensions_mean_hwl.double() + code.double() @ prior.dimensions_basis_hwl.double().T
        expected = 0.5 * (((linear - cars.detector_hwl.double()) / 0.1) ** 2).sum(dim=1)
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=0.0)


@pytest.mark.parametrize("kind", ["pca", "neural", "kernel_pca"])
def test_several_priors_of_the_dimensions(kind: str) -> None:
    cars, prior = _cars(3), prior_of(kind)
    residuals = [DimensionsResidual(prior, sigma) for sigma in ((0.1, 0.2, 0.3), (0.4, 0.1, 0.2))]
    terms = [PriorTerm("dimensions", 0.5 + i, cars, residual) for i, residual in enumerate(residuals)]
    state = _state(cars, prior.num_codes)
    stacked = StackedPriors.from_terms(terms, prior.num_codes)
    _same(linearised(stacked, state), _one_by_one(terms, state))
    keep = torch.tensor([False, True, True])
    part = linearised(stacked.of_objects(keep, 2), CarState(*(x[keep] for x in state)))
    _same(part, TermLinearisation(*(x[keep] for x in _one_by_one(terms, state))))


@dataclass(frozen=True)
class _OwnShape(ShapeResidual):
    """A hundred times the residual that it inherits."""

    def __call__(self, cars: CarBatch, at: AtState) -> PriorResidual:
        return PriorResidual(*(100.0 * x for x in super().__call__(cars, at)))


class _OwnTerm(PriorTerm):
    """A user's own way to a cost."""


def test_a_kind_made_from_a_known_one_is_not_taken_for_it() -> None:
    cars = _cars(2)
    assert StackedPriors.takes(PriorTerm("shape", 1.0, cars, ShapeResidual()))
    assert not StackedPriors.takes(PriorTerm("shape", 1.0, cars, _OwnShape()))
    assert not StackedPriors.takes(_OwnTerm("shape", 1.0, cars, ShapeResidual()))


def test_dimensions_of_a_prior_made_from_a_linear_one_may_be_curved() -> None:
    class Curved(PCAShapePrior):
        def dimensions_and_derivative(self, code: Tensor) -> DimensionsDerivative:
            at = super().dimensions_and_derivative(code)
            return DimensionsDerivative(at.hwl**2, 2 * at.hwl[..., None] * at.J_hwl_code)

    prior = copy.deepcopy(prior_of("pca"))
    prior.__class__ = Curved
    cars = _cars(2)
    terms = [PriorTerm("dimensions", 1.0, cars, DimensionsResidual(prior, (0.1, 0.1, 0.1)))]
    state = _state(cars, prior.num_codes)
    _same(linearised(StackedPriors.from_terms(terms, prior.num_codes), state), _one_by_one(terms, state))


def test_only_known_priors_are_stacked() -> None:
    def own(_: CarBatch, at: _At) -> PriorResidual:
        return shape_prior(at.state.code)

    term = PriorTerm("own", 1.0, _cars(2), own)
    assert not StackedPriors.takes(term)
    with pytest.raises(InputError, match="terms: expected at least one prior, all of known kinds, got own"):
        StackedPriors.from_terms([term], 3)
    with pytest.raises(InputError, match="got none"):
        StackedPriors.from_terms([], 3)


def test_few_operations_and_nothing_from_the_host() -> None:
    """A guard, not a measure: one by one these priors take more than three hundred operations."""
    cars = _cars(2, sigma=True)
    stacked = StackedPriors.from_terms(_terms(SETTINGS["pose"], "pca", cars), 3)
    state = CarState(*(x.float() for x in _state(cars, 3)))
    again = host_traffic(lambda: StackedPriors.from_terms(_terms(SETTINGS["default"], "pca", cars), 3))
    assert again.found == []
    traffic = host_traffic(lambda: stacked.parts(state))
    assert traffic.operations <= 33
    assert traffic.found == []
