"""Constants are right in every mode, whichever mode asked first, and lengths and joined flags are PyTorch's own."""

from __future__ import annotations

import copy

import pytest
import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.fx.experimental.proxy_tensor import make_fx

from directshape_torch.numerics.tensors import all_along, constant_like, length, made_once


class Constants:
    """A `Constants` has two constants that were not requested before."""

    def __init__(self, first: float) -> None:
        self.first = first

        @made_once
        def ramp(dtype: torch.dtype, device: torch.device) -> Tensor:
            return torch.arange(2, dtype=dtype, device=device)

        self.ramp = ramp

    def of(self, like: Tensor) -> tuple[Tensor, Tensor]:
        return constant_like((self.first, 2.0), like), self.ramp(like)

    def product(self, x: Tensor) -> Tensor:
        one, other = self.of(x)
        return x * (one + other)


def _asked_plainly(constants: Constants) -> None:
    assert constants.product(torch.ones(2)).tolist() == [constants.first, 3.0]


def _asked_in_jvp(constants: Constants) -> None:
    ones = torch.ones(2)
    value, slope = torch.func.jvp(constants.product, (ones,), (ones,))
    assert value.tolist() == slope.tolist() == [constants.first, 3.0]


def _asked_in_grad(constants: Constants) -> None:
    slope = torch.func.grad(lambda x: constants.product(x).sum())(torch.ones(2))
    assert slope.tolist() == [constants.first, 3.0]


def _asked_in_functionalize(constants: Constants) -> None:
    assert torch.func.functionalize(constants.product)(torch.ones(2)).tolist() == [constants.first, 3.0]


def _asked_of_fakes(constants: Constants) -> None:
    with FakeTensorMode():
        assert constants.product(torch.ones(2)).shape == (2,)


def _asked_by_a_tracer(constants: Constants) -> None:
    def product(x: Tensor) -> Tensor:  # a tracer would count the `self` of a method
        return constants.product(x)

    traced = make_fx(product, tracing_mode="fake")(torch.ones(2))
    assert traced(torch.ones(2)).tolist() == [constants.first, 3.0]


def _asked_in_inference_mode(constants: Constants) -> None:
    with torch.inference_mode():
        assert constants.product(torch.ones(2)).tolist() == [constants.first, 3.0]


ASKED = (
    _asked_plainly,
    _asked_in_jvp,
    _asked_in_grad,
    _asked_in_functionalize,
    _asked_of_fakes,
    _asked_by_a_tracer,
    _asked_in_inference_mode,
)


@pytest.mark.parametrize("then", range(len(ASKED)))
@pytest.mark.parametrize("before", range(len(ASKED)))
def test_constants_are_right_whoever_asked_before(before: int, then: int) -> None:
    constants = Constants(10.0 + before * len(ASKED) + then)
    for asked in (ASKED[before], ASKED[then]):
        asked(constants)
    for constant, numbers in zip(constants.of(torch.ones(2)), ([constants.first, 2.0], [0.0, 1.0]), strict=True):
        assert type(constant) is Tensor
        assert not constant.is_inference()
        assert copy.deepcopy(constant).tolist() == numbers
    for one, other in zip(constants.of(torch.ones(2)), constants.of(torch.zeros(1)), strict=True):
        assert one is other


def test_constants_of_another_type_are_others() -> None:
    constants = Constants(5.0)
    for dtype in (torch.float64, torch.float32):
        assert [x.dtype for x in constants.of(torch.ones(1, dtype=dtype))] == [dtype, dtype]


@pytest.mark.parametrize("dim", [0, 1, -1])
def test_length_is_the_euclidean_norm(dim: int) -> None:
    vectors = torch.randn(3, 4, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(length(vectors, dim), vectors.norm(dim=dim), rtol=1e-14, atol=0)


def test_length_has_the_derivative_of_the_norm() -> None:
    vectors = torch.randn(3, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: length(x, dim=0), vectors)


@pytest.mark.parametrize("dim", [0, 1, -1])
def test_all_along_is_all(dim: int) -> None:
    flags = torch.rand(4, 8, 5, generator=torch.Generator().manual_seed(0)) > 0.2
    together = all_along(flags, dim)
    assert torch.equal(together, flags.all(dim=dim))
    assert together.any()
    assert not together.all()
