"""What is differentiated in every mode of PyTorch."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch.autograd.forward_ad import dual_level
from torch.fx.experimental.proxy_tensor import make_fx

from directshape_torch.numerics.gradient_mode import as_constant, nothing_is_differentiated

ONES = torch.ones(2)


def jvp(function: Callable[[Tensor], Tensor]) -> Tensor:
    """The derivative by forward mode, at ones and along ones."""
    tangent: Tensor = torch.func.jvp(function, (ONES,), (ONES,))[1]
    return tangent


def doubled_as_asked(x: Tensor) -> Tensor:
    return 2 * x if nothing_is_differentiated() else 3 * x


def test_gradients_and_forward_mode_differentiate_and_nothing_else_does() -> None:
    assert not nothing_is_differentiated()
    with torch.inference_mode():
        assert nothing_is_differentiated()
    with torch.no_grad():
        assert nothing_is_differentiated()
        assert torch.equal(torch.func.vmap(doubled_as_asked)(ONES), 2 * ONES)
        with dual_level():
            assert not nothing_is_differentiated()
        assert torch.equal(jvp(doubled_as_asked), 3 * ONES)
        assert torch.equal(jvp(torch.func.vmap(doubled_as_asked)), 3 * ONES)
        assert torch.equal(jvp(lambda x: x * doubled_as_asked(ONES)), 3 * ONES)
        assert nothing_is_differentiated()


@pytest.mark.parametrize("tracing_mode", ["real", "fake", "symbolic"])
def test_a_tracer_can_ask(tracing_mode: str) -> None:
    with torch.no_grad():
        assert torch.equal(make_fx(jvp_of_x, tracing_mode=tracing_mode)(ONES)(ONES), 3 * ONES)
        assert torch.equal(make_fx(doubled_as_asked, tracing_mode=tracing_mode)(ONES)(ONES), 2 * ONES)


def jvp_of_x(x: Tensor) -> Tensor:
    tangent: Tensor = torch.func.jvp(doubled_as_asked, (x,), (torch.ones_like(x),))[1]
    return tangent


def test_a_compiler_can_ask() -> None:
    compiled = torch.compile(doubled_as_asked, backend="eager", fullgraph=True)
    assert torch.equal(torch.compile(jvp_of_x, backend="eager", fullgraph=True)(ONES), 3 * ONES)
    with torch.no_grad():
        assert torch.equal(compiled(ONES), 2 * ONES)
        with dual_level():
            assert torch.equal(compiled(ONES), 3 * ONES)
        assert torch.equal(compiled(ONES), 2 * ONES)


def test_a_constant_has_neither_gradient_nor_tangent() -> None:
    constant = as_constant(lambda x: x * x)
    x = torch.ones(2, requires_grad=True)
    assert not constant(x).requires_grad
    assert torch.equal(jvp(lambda x: x * constant(x)), ONES)
    in_between = torch.func.jacfwd(torch.func.jacfwd(lambda x: (x * x * constant(x)).sum()))(ONES)
    assert torch.equal(in_between, 2 * torch.eye(2))
