"""Sums over objects: against a naive loop, empty objects, isolation, the same bits every time."""

from __future__ import annotations

import copy

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from directshape_torch.solver.normal_equations import Segments

# Where nothing is differentiated sums take another way.
BOTH_WAYS = pytest.mark.parametrize("differentiated", [True, False])


@BOTH_WAYS
@settings(max_examples=25, deadline=None)
@given(counts=st.lists(st.integers(0, 300), max_size=6))
def test_against_a_loop(differentiated: bool, counts: list[int]) -> None:
    index = torch.repeat_interleave(torch.arange(len(counts)), torch.tensor(counts, dtype=torch.long))
    segments = Segments.of_sorted(index, len(counts))
    J = torch.randn(len(index), 4, dtype=torch.float64)
    first, second = torch.randn(2, len(index), dtype=torch.float64)
    with torch.set_grad_enabled(differentiated):
        gradient, hessian, further = segments.accumulate(J, first, second, first)
        total, twice = segments.sum(first), segments.sum(torch.stack([first, second], dim=1))
    assert segments.counts.tolist() == counts
    assert gradient.shape == (len(counts), 4)
    for i in range(len(counts)):
        own = index == i
        torch.testing.assert_close(total[i], first[own].sum(), rtol=1e-11, atol=1e-11)
        torch.testing.assert_close(twice[i, 1], second[own].sum(), rtol=1e-11, atol=1e-11)
        torch.testing.assert_close(gradient[i], (first[own, None] * J[own]).sum(0), rtol=1e-11, atol=1e-11)
        expected = (J[own] * second[own, None]).T @ J[own]
        torch.testing.assert_close(hessian[i], expected, rtol=1e-11, atol=1e-11)
        torch.testing.assert_close(further[i], (J[own] * first[own, None]).T @ J[own], rtol=1e-11, atol=1e-11)


@BOTH_WAYS
def test_objects_without_rows_sum_to_zero(differentiated: bool) -> None:
    segments = Segments.of_sorted(torch.tensor([1, 1, 3]), 5)
    with torch.set_grad_enabled(differentiated):
        assert segments.sum(torch.tensor([1.0, 2.0, 4.0])).tolist() == [0.0, 3.0, 0.0, 4.0, 0.0]


@BOTH_WAYS
@pytest.mark.parametrize("num_objects", [0, 3])
def test_no_rows(num_objects: int, differentiated: bool) -> None:
    segments = Segments.of_sorted(torch.zeros(0, dtype=torch.long), num_objects)
    with torch.set_grad_enabled(differentiated):
        gradient, hessian = segments.accumulate(torch.zeros(0, 4), torch.zeros(0), torch.zeros(0))
        assert segments.sum(torch.zeros(0)).tolist() == [0.0] * num_objects
    assert (gradient.shape, hessian.shape) == ((num_objects, 4), (num_objects, 4, 4))


@BOTH_WAYS
def test_nan_and_infinity_stay_in_their_object(differentiated: bool) -> None:
    index = torch.repeat_interleave(torch.arange(3), torch.tensor([70, 130, 64]))
    segments = Segments.of_sorted(index, 3)
    values, J = torch.ones(264), torch.ones(264, 2)
    values[100], J[150] = torch.nan, torch.inf
    with torch.set_grad_enabled(differentiated):
        gradient, hessian = segments.accumulate(J, values, values)
        total = segments.sum(values)
    for result in (total, gradient.sum(1), hessian.sum((1, 2))):
        assert result.isfinite().tolist() == [True, False, True]
    assert total[[0, 2]].tolist() == [70.0, 64.0]


@BOTH_WAYS
def test_float32_rows_are_summed_in_float64(differentiated: bool) -> None:
    rows = torch.full((200_000,), 0.1)
    with torch.set_grad_enabled(differentiated):
        total = Segments.of_sorted(torch.zeros(200_000, dtype=torch.long), 1).sum(rows)
    assert total.dtype == torch.float64
    assert abs(float(total) - 200_000 * float(rows[0])) < 1e-6


@BOTH_WAYS
def test_an_objects_sums_do_not_depend_on_its_neighbours(differentiated: bool) -> None:
    generator = torch.Generator().manual_seed(1)
    J = torch.randn(500, 9, generator=generator)
    weights = torch.rand(500, generator=generator)
    alone = Segments.of_sorted(torch.zeros(500, dtype=torch.long), 1)
    crowd = torch.cat([torch.zeros(37), torch.ones(500), torch.full((2000,), 2.0)]).long()
    rows = torch.cat([torch.randn(37, 9), J, torch.randn(2000, 9)])
    w = torch.cat([torch.ones(37), weights, torch.ones(2000)])
    together = Segments.of_sorted(crowd, 3)
    with torch.set_grad_enabled(differentiated):
        sums = alone.accumulate(J, weights, weights), together.accumulate(rows, w, w)
    for a, b in zip(*sums, strict=True):
        torch.testing.assert_close(b[1], a[0], rtol=1e-13, atol=1e-13)


def test_blocks_of_objects_in_their_places() -> None:
    """As many as are needed, none of an object without rows, and an empty place is no row."""
    counts = torch.tensor([1, 64, 0, 65, 130])
    blocks = Segments.of_sorted(torch.repeat_interleave(torch.arange(5), counts), 5)
    assert blocks.num_blocks.tolist() == [1, 1, 0, 2, 3]
    assert blocks.owner.tolist() == [0, 1, 3, 3, 4, 4, 4]
    assert blocks.block_rows[:, 0].tolist() == [0, 1, 65, 129, 130, 194, 258]
    filled = blocks.block_rows < 260
    assert filled.sum(dim=1).tolist() == [1, 64, 64, 1, 64, 64, 2]
    assert blocks.block_rows[filled].tolist() == list(range(260))
    assert blocks.object_blocks.tolist() == [[0, 7, 7, 7], [1, 7, 7, 7], [7, 7, 7, 7], [2, 3, 7, 7], [4, 5, 6, 7]]


def test_sums_are_differentiable() -> None:
    segments = Segments.of_sorted(torch.tensor([0, 0, 2]), 3)
    values = torch.tensor([1.0, 2.0, 3.0], requires_grad=True)
    (segments.sum(values) * torch.tensor([2.0, 5.0, 7.0])).sum().backward()
    assert values.grad is not None
    assert values.grad.tolist() == [2.0, 2.0, 7.0]


def test_sums_are_differentiable_again_and_forwards() -> None:
    segments = Segments.of_sorted(torch.tensor([0, 0, 2]), 3)
    values = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64, requires_grad=True)
    torch.autograd.gradgradcheck(lambda x: segments.sum(x * x), values)
    with torch.no_grad():
        total, slope = torch.func.jvp(segments.sum, (values.detach(),), (2 * torch.ones_like(values),))
    assert (total.tolist(), slope.tolist()) == ([3.0, 0.0, 3.0], [4.0, 0.0, 2.0])


def test_what_a_transform_has_asked_for_is_not_kept() -> None:
    segments = Segments.of_sorted(torch.tensor([0, 0, 2]), 3)
    torch.func.jvp(segments.sum, (torch.ones(3),), (torch.ones(3),))
    assert copy.deepcopy(segments).sum(torch.ones(3)).tolist() == [2.0, 0.0, 1.0]


def test_what_inference_mode_has_asked_for_can_be_differentiated_with() -> None:
    with torch.inference_mode():
        segments = Segments.of_sorted(torch.tensor([0, 0, 2]), 3)
        segments.accumulate(torch.ones(3, 2), torch.ones(3), torch.ones(3))
    kept = Segments.of_sorted(torch.tensor([0, 0, 2]), 3)
    with torch.inference_mode():
        kept.accumulate(torch.ones(3, 2), torch.ones(3), torch.ones(3))
    for each in (segments, kept):
        rows = torch.ones(3, 2, requires_grad=True)
        each.accumulate(rows, torch.ones(3), torch.ones(3))[1].sum().backward()
        assert rows.grad is not None
        assert rows.grad.tolist() == [[4.0, 4.0]] * 3


@BOTH_WAYS
def test_the_same_bits_twice(differentiated: bool) -> None:
    index = torch.randint(0, 7, (5000,)).sort().values
    J, w = torch.randn(5000, 11), torch.rand(5000)
    with torch.set_grad_enabled(differentiated):
        results = [Segments.of_sorted(index, 7).accumulate(J, w, w) for _ in range(2)]
    for a, b in zip(*results, strict=True):
        assert (a == b).all()
