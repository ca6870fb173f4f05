"""Peak memory of tensors, by hand."""

from __future__ import annotations

import torch

from directshape_torch.benchmark.memory import peak_tensor_bytes

MEGABYTE = 2**20


def test_the_peak_is_of_tensors_alive_at_once() -> None:
    def call() -> float:
        a = torch.zeros(MEGABYTE, dtype=torch.uint8)
        b = torch.zeros(2 * MEGABYTE, dtype=torch.uint8)
        del a
        c = torch.zeros(MEGABYTE // 2, dtype=torch.uint8)
        return float(b[0] + c[0])

    # a and b live together (3 MB), then b and c (2.5 MB).
    assert abs(peak_tensor_bytes(call) - 3 * MEGABYTE) < 1024


def test_what_lived_before_does_not_count() -> None:
    before = torch.zeros(MEGABYTE)

    assert 0 < peak_tensor_bytes(before.sum) < 1024


def test_a_call_without_tensors_needs_none() -> None:
    assert peak_tensor_bytes(lambda: None) == 0
