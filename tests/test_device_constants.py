"""Constants and kept properties: right in every mode, whichever of them asked first."""

from __future__ import annotations

import copy

import pytest
import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode

from directshape_torch.device_constants import constant_like, kept_property, made_once


def constants_of(like: Tensor, first: float) -> tuple[Tensor, Tensor]:
    return constant_like((first, 2.0), like), _ramp(like)


@made_once
def _ramp(dtype: torch.dtype, device: torch.device) -> Tensor:
    return torch.arange(2, dtype=dtype, device=device)


class Numbers:
    def __init__(self, numbers: Tensor) -> None:
        self.numbers = numbers

    @kept_property
    def doubled(self) -> Tensor:
        return 2 * self.numbers


def _asked_in_jvp(first: float) -> None:
    ones = torch.ones(2)
    torch.func.jvp(lambda x: x * sum(constants_of(x, first)), (ones,), (ones,))


def _asked_in_grad(first: float) -> None:
    torch.func.grad(lambda x: (x * sum(constants_of(x, first))).sum())(torch.ones(2))


def _asked_of_fakes(first: float) -> None:
    with FakeTensorMode():
        constants_of(torch.ones(2), first)


def _asked_in_inference_mode(first: float) -> None:
    with torch.inference_mode():
        constants_of(torch.ones(2), first)


ASKED = (_asked_in_jvp, _asked_in_grad, _asked_of_fakes, _asked_in_inference_mode)


@pytest.mark.parametrize("number", range(len(ASKED)))
def test_constants_are_plain_whoever_asked_first(number: int) -> None:
    first = 10.0 + number  # one that nobody has asked for before
    ASKED[number](first)
    for constant, numbers in zip(constants_of(torch.ones(2), first), ([first, 2.0], [0.0, 1.0]), strict=True):
        assert type(constant) is Tensor
        assert not constant.is_inference()
        assert copy.deepcopy(constant).tolist() == numbers
    assert constant_like((first, 2.0), torch.ones(2)) is constant_like((first, 2.0), torch.zeros(1))


def test_constants_of_another_type_are_others() -> None:
    double, single = (_ramp(torch.ones(1, dtype=dtype)) for dtype in (torch.float64, torch.float32))
    assert (double.dtype, single.dtype) == (torch.float64, torch.float32)


def test_a_property_is_kept() -> None:
    numbers = Numbers(torch.ones(2))
    assert numbers.doubled is numbers.doubled
    assert isinstance(Numbers.doubled, kept_property)


def test_a_property_of_a_transform_is_not_kept() -> None:
    numbers = Numbers(torch.ones(2))
    torch.func.jvp(lambda x: x * numbers.doubled, (torch.ones(2),), (torch.ones(2),))
    assert copy.deepcopy(numbers).doubled.tolist() == [2.0, 2.0]


def test_a_property_that_inference_mode_asked_for_can_be_differentiated_with() -> None:
    numbers, x = Numbers(torch.ones(2)), torch.ones(2, requires_grad=True)
    with torch.inference_mode():
        assert numbers.doubled.tolist() == [2.0, 2.0]
    (x * numbers.doubled).sum().backward()
    assert x.grad is not None
    assert x.grad.tolist() == [2.0, 2.0]
