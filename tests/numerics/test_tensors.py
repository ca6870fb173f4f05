"""Constants are right in every mode, whichever mode asked first, and lengths and joined flags are PyTorch's own."""

from __future__ import annotations

import copy
from collections.abc import Callable

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


ONES = torch.ones(2)


def _by_a_tracer(constants: Constants) -> Tensor:
    def product(x: Tensor) -> Tensor:  # a tracer would count the `self` of a method
        return constants.product(x)

    return make_fx(product, tracing_mode="fake")(ONES)(ONES)


def _of_fakes(constants: Constants) -> Tensor:
    with FakeTensorMode():
        assert constants.product(torch.ones(2)).shape == (2,)
    return constants.product(ONES)


ASKED: dict[str, Callable[[Constants], Tensor]] = {
    "plainly": lambda c: c.product(ONES),
    "in jvp": lambda c: torch.func.jvp(c.product, (ONES,), (ONES,))[1],
    "in grad": lambda c: torch.func.grad(lambda x: c.product(x).sum())(ONES),
    "in functionalize": lambda c: torch.func.functionalize(c.product)(ONES),
    "by a tracer": _by_a_tracer,
    "of fakes": _of_fakes,
    "in inference mode": torch.inference_mode()(lambda c: c.product(ONES)),
}


@pytest.mark.parametrize("then", ASKED)
@pytest.mark.parametrize("before", ASKED)
def test_constants_are_right_whoever_asked_before(before: str, then: str) -> None:
    constants = Constants(10.0 + len(ASKED) * list(ASKED).index(before) + list(ASKED).index(then))
    for asked in (ASKED[before], ASKED[then]):
        assert asked(constants).tolist() == [constants.first, 3.0]
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
