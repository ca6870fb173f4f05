"""Whatever a user has allowed for a network, here products have all digits; afterwards the setting is as it was."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest
import torch

from directshape_torch.numerics.full_precision import full_precision

CUDA, CPU = torch.backends.cuda.matmul, torch.backends.mkldnn.matmul


@pytest.fixture(autouse=True)
def _as_it_was() -> Iterator[None]:
    yield
    torch.backends.fp32_precision = CUDA.fp32_precision = CPU.fp32_precision = "none"
    torch.set_float32_matmul_precision("highest")
    CUDA.fp32_precision = CPU.fp32_precision = "none"


def seen() -> tuple[str, str]:
    return CUDA.fp32_precision, CPU.fp32_precision


@pytest.mark.parametrize("asked", ["highest", "high", "medium"])
def test_fewer_digits_are_not_allowed_inside_and_again_afterwards(asked: str) -> None:
    torch.set_float32_matmul_precision(asked)
    before = seen()
    with full_precision("cpu"):
        assert set(seen()) <= {"none", "ieee"}
    assert seen() == before
    assert torch.get_float32_matmul_precision() == asked
    assert (asked == "highest") == (set(before) <= {"none", "ieee"})


def test_the_newer_name_of_the_setting() -> None:
    CUDA.fp32_precision = "tf32"
    with full_precision("cpu"):
        assert CUDA.fp32_precision == "ieee"
    assert CUDA.fp32_precision == "tf32"


def test_what_follows_the_setting_of_all_backends_goes_on_following_it() -> None:
    torch.backends.fp32_precision = "tf32"
    with full_precision("cpu"):
        assert seen() == ("ieee", "ieee")
    assert seen() == ("tf32", "tf32")
    torch.backends.fp32_precision = "ieee"
    assert seen() == ("ieee", "ieee")


def test_the_last_thread_to_leave_puts_the_setting_back() -> None:
    torch.set_float32_matmul_precision("high")
    entered, may_leave = threading.Event(), threading.Event()

    def other() -> None:
        with full_precision("cpu"):
            entered.set()
            may_leave.wait(10)

    thread = threading.Thread(target=other)
    with full_precision("cpu"):
        thread.start()
        assert entered.wait(10)
    assert CUDA.fp32_precision == "ieee"
    may_leave.set()
    thread.join()
    assert torch.get_float32_matmul_precision() == "high"


def test_autocast_is_off_inside() -> None:
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert (torch.eye(2) @ torch.eye(2)).dtype == torch.bfloat16
        with full_precision("cpu"):
            assert (torch.eye(2) @ torch.eye(2)).dtype == torch.float32
