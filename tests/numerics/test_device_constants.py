"""Constants are right in every mode, whichever mode asked first."""

from __future__ import annotations

import copy

import pytest
import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.fx.experimental.proxy_tensor import make_fx

from directshape_torch.numerics.tensors import constant_like, made_once


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
