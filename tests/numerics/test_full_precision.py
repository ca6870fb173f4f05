"""Products have all digits whatever a user has allowed for a network, and the setting is unchanged afterwards."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest
import torch

from directshape_torch.numerics.full_precision import full_precision, in_full_precision

CUDA, CPU = torch.backends.cuda.matmul, getattr(torch.backends.mkldnn, "matmul", None)
HAS_NEWER_NAME = hasattr(torch.backends, "fp32_precision")
needs_newer_name = pytest.mark.skipif(not HAS_NEWER_NAME, reason="PyTorch is older than 2.9")


@pytest.fixture(autouse=True)
def _as_it_was() -> Iterator[None]:
    yield
    if HAS_NEWER_NAME:
        torch.backends.fp32_precision = CUDA.fp32_precision = CPU.fp32_precision = "none"
    torch.set_float32_matmul_precision("highest")
    if HAS_NEWER_NAME:
        CUDA.fp32_precision = CPU.fp32_precision = "none"


def seen() -> tuple[str, str]:
    return CUDA.fp32_precision, CPU.fp32_precision


@needs_newer_name
@pytest.mark.parametrize("asked", ["highest", "high", "medium"])
def test_fewer_digits_are_not_allowed_inside_and_again_afterwards(asked: str) -> None:
    torch.set_float32_matmul_precision(asked)
    before = seen()
    with full_precision():
        assert set(seen()) <= {"none", "ieee"}
    assert seen() == before
    assert torch.get_float32_matmul_precision() == asked
    assert (asked == "highest") == (set(before) <= {"none", "ieee"})


@needs_newer_name
def test_what_follows_the_setting_of_all_backends_goes_on_following_it() -> None:
    torch.backends.fp32_precision = "tf32"
    with full_precision():
        assert seen() == ("ieee", "ieee")
    assert seen() == ("tf32", "tf32")
    torch.backends.fp32_precision = "ieee"
    assert seen() == ("ieee", "ieee")
    CUDA.fp32_precision = "tf32"
    with full_precision():
        assert CUDA.fp32_precision == "ieee"
    assert CUDA.fp32_precision == "tf32"


def test_the_last_thread_to_leave_puts_the_setting_back() -> None:
    torch.set_float32_matmul_precision("high")
    entered, may_leave = threading.Event(), threading.Event()

    def other() -> None:
        with full_precision():
            entered.set()
            may_leave.wait(10)

    thread = threading.Thread(target=other)
    with full_precision():
        thread.start()
        assert entered.wait(10)
    assert torch.get_float32_matmul_precision() == "highest"
    may_leave.set()
    thread.join()
    assert torch.get_float32_matmul_precision() == "high"


@pytest.mark.parametrize("device", ["cpu", "cuda", "xpu", "mps"])
def test_autocast_is_off_inside_and_on_again_afterwards(device: str) -> None:
    torch.set_autocast_enabled(device, True)
    try:
        with full_precision():
            assert not torch.is_autocast_enabled(device)
        assert torch.is_autocast_enabled(device)
    finally:
        torch.set_autocast_enabled(device, False)


@in_full_precision
def product(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    return a @ b


A, B = torch.full((2, 2), 1.001), torch.full((2, 2), 1 / 3)


def test_a_marked_function_within_autocast_and_allowed_tf32() -> None:
    torch.set_float32_matmul_precision("high")
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert (A @ B).dtype == torch.bfloat16
        torch.testing.assert_close(product(A, B), 2 * A * B, rtol=1e-6, atol=0)
        assert torch.is_autocast_enabled("cpu")
    assert torch.get_float32_matmul_precision() == "high"


@pytest.mark.parametrize(
    ("first", "second", "found"),
    [
        (torch.bfloat16, torch.float32, torch.float32),
        (torch.float16, torch.bfloat16, torch.float32),
        (torch.float32, torch.float64, torch.float32),
        (torch.float64, torch.float16, torch.float64),
    ],
)
def test_the_first_tensor_says_the_dtype(first: torch.dtype, second: torch.dtype, found: torch.dtype) -> None:
    a, b = A.to(first), B.to(second)
    torch.testing.assert_close(product(a, b=b), a.to(found) @ b.to(found), rtol=0, atol=0)


def test_a_marked_function_in_the_users_own_compilation() -> None:
    compiled = torch.compile(product, backend="eager", fullgraph=True)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        torch.testing.assert_close(compiled(A, B), product(A, B), rtol=0, atol=0)


def test_gradients_reach_tensors_of_half_precision() -> None:
    a = A.bfloat16().requires_grad_()
    product(a, B).sum().backward()
    assert a.grad is not None
    torch.testing.assert_close(a.grad, (torch.ones(2, 2) @ B.T).bfloat16())
