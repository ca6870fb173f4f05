"""Constants and kept properties: right in every mode, whichever of them asked first."""

from __future__ import annotations

import copy

import pytest
import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.fx.experimental.proxy_tensor import make_fx

from directshape_torch.device_constants import constant_like, kept_property, made_once


class Constants:
    """Two that nobody has asked for before."""

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


class Numbers:
    def __init__(self, numbers: Tensor) -> None:
        self.numbers = numbers

    @kept_property
    def doubled(self) -> Tensor:
        return 2 * self.numbers


def _asked_plainly(constants: Constants) -> None:
    assert constants.product(torch.ones(2)).tolist() == [constants.first, 3.0]


def _asked_in_jvp(constants: Constants) -> None:
    ones = torch.ones(2)
    value, slope = torch.func.jvp(constants.product, (ones,), (ones,))
    assert value.tolist() == slope.tolist() == [constants.first, 3.0]


def _asked_in_grad(constants: Constants) -> None:
    slope = torch.func.grad(lambda x: constants.product(x).sum())(torch.ones(2))
    assert slope.tolist() == [constants.first, 3.0]


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


def test_a_property_is_kept() -> None:
    numbers = Numbers(torch.ones(2))
    assert numbers.doubled is numbers.doubled
    assert isinstance(Numbers.doubled, kept_property)


def test_a_property_of_a_transform_is_not_kept() -> None:
    numbers = Numbers(torch.ones(2))
    torch.func.jvp(lambda x: x * numbers.doubled, (torch.ones(2),), (torch.ones(2),))
    assert copy.deepcopy(numbers).doubled.tolist() == [2.0, 2.0]


def test_a_property_with_a_graph_or_a_tangent_is_not_kept() -> None:
    numbers = Numbers(torch.ones(2, requires_grad=True))
    for _ in range(2):
        numbers.doubled.sum().backward()
    with torch.autograd.forward_ad.dual_level():
        dual = Numbers(torch.autograd.forward_ad.make_dual(torch.ones(2), torch.ones(2)))
        assert dual.doubled.tolist() == [2.0, 2.0]
    assert "doubled" not in numbers.__dict__
    assert "doubled" not in dual.__dict__


def test_a_property_that_inference_mode_asked_for_can_be_differentiated_with() -> None:
    numbers, x = Numbers(torch.ones(2)), torch.ones(2, requires_grad=True)
    with torch.inference_mode():
        assert numbers.doubled.tolist() == [2.0, 2.0]
    (x * numbers.doubled).sum().backward()
    assert x.grad is not None
    assert x.grad.tolist() == [2.0, 2.0]
