"""A prior that cannot be refined is refused when the refiner is made, with the reason."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers.ellipsoids import ellipsoid_prior
from helpers.priors import KINDS, prior_of
from helpers.problems import DEFAULT
from torch import Tensor, nn

from directshape_torch.config import BackwardConfig, RefinerConfig
from directshape_torch.errors import InputError
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.shape.check_prior import check_prior
from directshape_torch.shape.sdf_grid import GridShape
from directshape_torch.shape.shape_prior import SdfDerivatives

AUTOGRAD = replace(DEFAULT, solver=replace(DEFAULT.solver, jacobian="autograd"))


class Wrapped(nn.Module):
    """A `Wrapped` has the ellipsoids with a fault that a test adds by overriding one method."""

    def __init__(self) -> None:
        super().__init__()
        self.inner = ellipsoid_prior()

    def __getattr__(self, name: str) -> object:
        return nn.Module.__getattr__(self, name) if name == "inner" else getattr(self.inner, name)


class OnlyValues:
    """An `OnlyValues` is a bound shape without derivatives."""

    def __init__(self, shape: GridShape) -> None:
        self.value = shape.value


class WithoutDerivatives(Wrapped):
    def bind(self, code: Tensor) -> OnlyValues:
        return OnlyValues(self.inner.bind(code))


class Transposed(GridShape):
    def value_and_derivatives(self, points_obj: Tensor, object_index: Tensor) -> SdfDerivatives:
        at = super().value_and_derivatives(points_obj, object_index)
        return at._replace(J_value_code=at.J_value_code.T)


class TransposedCodeDerivative(Wrapped):
    def bind(self, code: Tensor) -> Transposed:
        shape = self.inner.bind(code)
        return Transposed(*shape)


class Detached(Wrapped):
    """A `Detached` has its own derivatives, but none that autograd could find."""

    def bind(self, code: Tensor) -> GridShape:
        return self.inner.bind(code.detach())


class DetachedShape(GridShape):
    def value_and_derivatives(self, points_obj: Tensor, object_index: Tensor) -> SdfDerivatives:
        at = super().value_and_derivatives(points_obj, object_index)
        return at._replace(gradient=at.gradient.detach())


class DetachedGradient(Wrapped):
    """A `DetachedGradient` has values with a graph and a gradient without, so second derivatives would be wrong."""

    def bind(self, code: Tensor) -> DetachedShape:
        shape = self.inner.bind(code)
        return DetachedShape(*shape)


def test_a_wrapped_prior_without_fault_is_taken() -> None:
    DirectShapeRefiner(Wrapped(), AUTOGRAD)


@pytest.mark.parametrize(
    ("prior", "message"),
    [
        (nn.Linear(1, 1), r"prior: expected a ShapePrior, got Linear without \['num_codes', 'bounds_obj'"),
        (WithoutDerivatives(), r"expected a BoundShape, got OnlyValues without \['value_and_derivatives'\]"),
        (TransposedCodeDerivative(), r"J_value_code: expected a tensor of shape \(1, 3\) at one point, got \(3, 1\)"),
    ],
)
def test_a_prior_without_gradients_is_refused(prior: nn.Module, message: str) -> None:
    with pytest.raises(InputError, match=message):
        DirectShapeRefiner(prior, DEFAULT)


def test_autograd_needs_a_graph_from_the_code() -> None:
    DirectShapeRefiner(Detached(), DEFAULT)
    with pytest.raises(InputError, match=r"expected a graph from points and code .* got none from code; compute it"):
        DirectShapeRefiner(Detached(), AUTOGRAD)


@pytest.mark.parametrize("config", [AUTOGRAD, replace(DEFAULT, backward=BackwardConfig(mode="implicit"))])
def test_derivatives_need_a_graph_too(config: RefinerConfig) -> None:
    DirectShapeRefiner(DetachedGradient(), DEFAULT)
    with pytest.raises(InputError, match=r"value_and_derivatives: gradient: expected a graph .* backward.mode='none'"):
        DirectShapeRefiner(DetachedGradient(), config)


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_ours_has_the_graphs(kind: str) -> None:
    check_prior(prior_of(kind), by_autograd=True)


def test_tensors_of_inference_mode_are_refused_where_a_graph_is_needed() -> None:
    with torch.inference_mode():
        prior = ellipsoid_prior()
    with pytest.raises(InputError, match=r"prior: .* got mean, basis, .* make it outside of torch.inference_mode"):
        DirectShapeRefiner(prior, AUTOGRAD)
