"""Entries of flat tensors: as indexing gives them, plain, differentiated and compiled."""

from __future__ import annotations

import pytest
import torch

from directshape_torch.numerics.tensors import take

FLAT = torch.arange(5.0, dtype=torch.float64) ** 2


@pytest.mark.parametrize("shape", [(), (7,), (2, 3, 4), (0, 3)])
def test_it_is_indexing(shape: tuple[int, ...]) -> None:
    index = torch.randint(0, 5, shape, generator=torch.Generator().manual_seed(0))
    assert torch.equal(take(FLAT, index), FLAT[index])


def test_entries_may_be_any_views_index() -> None:
    index = torch.tensor([[0, 1, 2], [3, 4, 0]]).mT
    assert torch.equal(take(FLAT, index), FLAT[index])


def test_an_entry_taken_twice_has_both_derivatives() -> None:
    flat = FLAT.clone().requires_grad_()
    take(flat, torch.tensor([[1, 1], [4, 0]])).sum().backward()
    assert torch.equal(flat.grad, torch.tensor([1.0, 2.0, 0.0, 0.0, 1.0], dtype=torch.float64))


def test_traced_code_gives_the_same() -> None:
    index = torch.tensor([[4, 0], [2, 2]])
    traced = torch.compile(take, fullgraph=True, backend="eager")
    assert torch.equal(traced(FLAT, index), FLAT[index])
