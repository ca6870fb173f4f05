"""Blocks of 64 rows: layout, joining, leaving objects out, and their sums, against loops over rows."""

from __future__ import annotations

import itertools

import pytest
import torch
from torch import Tensor

from directshape_torch.tracking.blocks import BlockParts, Blocks, PackedBlocks, WeightedBlocks, weighted_products

COUNTS = [[0], [3], [64], [65, 0, 1], [130, 64, 0, 200], [0, 0, 5], []]
UNKNOWNS = 4


def index_of(counts: list[int]) -> Tensor:
    return torch.arange(len(counts)).repeat_interleave(torch.tensor(counts, dtype=torch.long))


def rows_of(counts: list[int], seed: int = 0) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Jacobians, both weights and a cost of each row."""
    generator = torch.Generator().manual_seed(seed)
    total = sum(counts)
    J, *others = (torch.randn(total, n, generator=generator, dtype=torch.float64) for n in (UNKNOWNS, 1, 1, 1))
    return J, *(x[:, 0] for x in others)  # type: ignore[return-value]


def sums_of(packed: PackedBlocks, rows: tuple[Tensor, ...], weight: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Sums over objects of what the rows of `packed` hold, its empty places without a weight."""
    J, first, second, cost = (x[packed.rows] for x in rows)
    first, second, cost = (torch.where(packed.filled, x, torch.zeros_like(x)) for x in (first, second, cost))
    owner = packed.blocks.owner
    parts = BlockParts(cost.sum(dim=1), weighted_products(J, first, second))
    return WeightedBlocks.of(packed.blocks, weight[owner]).sums([parts])


def looped(index: Tensor, rows: tuple[Tensor, ...], weight: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """One row after the other."""
    J, first, second, cost = rows
    total = torch.zeros(len(weight), dtype=torch.float64)
    gradient = torch.zeros(len(weight), UNKNOWNS, dtype=torch.float64)
    matrix = torch.zeros(len(weight), UNKNOWNS, UNKNOWNS, dtype=torch.float64)
    for r, b in enumerate(index.tolist()):
        total[b] += weight[b] * cost[r]
        gradient[b] += weight[b] * first[r] * J[r]
        matrix[b] += weight[b] * second[r] * torch.outer(J[r], J[r])
    return total, gradient, matrix


def blocks_of_each(blocks: Blocks) -> list[list[int]]:
    """By their places in order: object by object."""
    order = WeightedBlocks.of(blocks, torch.ones(len(blocks.owner), dtype=torch.float64))
    places = [*order.first.tolist(), len(blocks.owner)]
    assert [end - begin for begin, end in itertools.pairwise(places)] == list(blocks.counts)
    return [order.by_object[begin:end].tolist() for begin, end in itertools.pairwise(places)]


def weights(num_objects: int) -> Tensor:
    return torch.arange(1, num_objects + 1, dtype=torch.float64)


def assert_same(found: tuple[Tensor, ...], expected: tuple[Tensor, ...]) -> None:
    for x, y in zip(found, expected, strict=True):
        torch.testing.assert_close(x, y, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("counts", COUNTS)
def test_sums_against_a_loop(counts: list[int]) -> None:
    index, rows = index_of(counts), rows_of(counts)
    weight = weights(len(counts))
    assert_same(sums_of(PackedBlocks.of_sorted(index, len(counts)), rows, weight), looped(index, rows, weight))


@pytest.mark.parametrize("counts", COUNTS)
def test_every_row_has_one_place_and_empty_places_repeat_their_own_object(counts: list[int]) -> None:
    index = index_of(counts)
    packed = PackedBlocks.of_sorted(index, len(counts))
    assert packed.rows[packed.filled].tolist() == list(range(len(index)))
    assert torch.equal(index[packed.rows], packed.blocks.owner[:, None].expand_as(packed.rows))
    assert len(packed.blocks.owner) == sum(-(-count // 64) for count in counts)
    for b, own in enumerate(blocks_of_each(packed.blocks)):
        assert own == (packed.blocks.owner == b).nonzero()[:, 0].tolist()


LEFT, RIGHT = [130, 0, 64, 3], [5, 70, 0, 300]


def _joined() -> tuple[Blocks, list[PackedBlocks]]:
    parts = [PackedBlocks.of_sorted(index_of(counts), 4) for counts in (LEFT, RIGHT)]
    return Blocks.join([part.blocks for part in parts]), parts


def _of_both(blocks: Blocks, parts: list[PackedBlocks], weight: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    of_each = []
    for number, (packed, counts) in enumerate(zip(parts, (LEFT, RIGHT), strict=True)):
        J, first, second, cost = (x[packed.rows] for x in rows_of(counts, number))
        first, second, cost = (torch.where(packed.filled, x, torch.zeros_like(x)) for x in (first, second, cost))
        of_each.append(BlockParts(cost.sum(dim=1), weighted_products(J, first, second)))
    return WeightedBlocks.of(blocks, weight[blocks.owner]).sums(of_each)


@pytest.mark.parametrize("sides", [[LEFT, RIGHT], [RIGHT], [[], []], [[0, 0], [65, 0], [0, 1]]])
def test_blocks_of_objects_numbered_on_from_side_to_side_are_those_of_the_sides_joined(sides: list[list[int]]) -> None:
    count = len(sides[0])
    expected = Blocks.join([PackedBlocks.of_sorted(index_of(counts), count).blocks for counts in sides])
    everything = [number for counts in sides for number in counts]
    found = PackedBlocks.of_sorted(index_of(everything), len(everything)).blocks.of_sides(len(sides))
    assert torch.equal(found.owner, expected.owner)
    assert found.counts == expected.counts


def test_joined_blocks_add_what_their_parts_give() -> None:
    blocks, parts = _joined()
    weight = weights(4)
    each = [looped(index_of(counts), rows_of(counts, n), weight) for n, counts in enumerate((LEFT, RIGHT))]
    assert_same(_of_both(blocks, parts, weight), tuple(a + b for a, b in zip(*each, strict=True)))
    assert blocks.owner.tolist() == [0, 0, 0, 2, 3, 0, 1, 1, 3, 3, 3, 3, 3]
    assert blocks_of_each(blocks) == [[0, 1, 2, 5], [6, 7], [3], [4, 8, 9, 10, 11, 12]]


def test_one_block_of_every_object() -> None:
    """As priors have it: its sum is itself, beside those of other rows and alone."""
    blocks, _ = _joined()
    every = Blocks.one_each(4, torch.device("cpu"))
    own = BlockParts(weights(4), torch.randn(4, UNKNOWNS + 1, UNKNOWNS, dtype=torch.float64))
    ones = torch.ones(4, dtype=torch.float64)
    cost, gradient, hessian = WeightedBlocks.of(every, ones).sums([own])
    assert torch.equal(cost, own.cost)
    assert torch.equal(torch.cat([hessian, gradient[:, None]], dim=1), own.products)
    others = BlockParts(torch.ones(len(blocks.owner), dtype=torch.float64), own.products[blocks.owner])
    joined = Blocks.join([blocks, every])
    assert joined.counts == tuple(1 + count for count in blocks.counts)
    together = WeightedBlocks.of(joined, torch.ones(len(joined.owner), dtype=torch.float64)).sums([others, own])
    expected = own.cost + torch.tensor(blocks.counts)
    torch.testing.assert_close(together.cost, expected)
    torch.testing.assert_close(together.gradient, gradient * (1 + torch.tensor(blocks.counts))[:, None].double())


def test_one_part_joined_is_itself() -> None:
    blocks = PackedBlocks.of_sorted(index_of(LEFT), 4).blocks
    joined = Blocks.join([blocks])
    assert torch.equal(joined.owner, blocks.owner)
    assert blocks_of_each(joined) == blocks_of_each(blocks)
    assert joined.counts == blocks.counts


@pytest.mark.parametrize("keep", [[0, 1, 2, 3], [0, 3], [1], [2, 3], []])
def test_objects_that_leave_take_their_blocks_along(keep: list[int]) -> None:
    """And change no bit of the others' sums."""
    blocks, parts = _joined()
    weight = weights(4)
    kept = torch.zeros(4, dtype=torch.bool)
    kept[keep] = True
    fewer, chosen = blocks.of_objects(kept, keep)
    assert torch.equal(chosen, kept[blocks.owner].nonzero()[:, 0])
    assert fewer.counts == tuple(torch.bincount(fewer.owner, minlength=len(keep)).tolist())
    assert [keep[b] for b in fewer.owner.tolist()] == blocks.owner[chosen].tolist()
    generator = torch.Generator().manual_seed(1)
    count = len(blocks.owner)
    cost = torch.randn(count, generator=generator, dtype=torch.float64)
    products = torch.randn(count, UNKNOWNS + 1, UNKNOWNS, generator=generator, dtype=torch.float64)
    all_of_them = WeightedBlocks.of(blocks, weight[blocks.owner]).sums([BlockParts(cost, products)])
    of_kept = BlockParts(cost[chosen], products[chosen])
    some = WeightedBlocks.of(fewer, weight[kept][fewer.owner]).sums([of_kept])
    for x, y in zip(some, all_of_them, strict=True):
        assert torch.equal(x, y[kept])
    assert len(parts) == 2


def test_an_objects_sums_do_not_depend_on_how_many_blocks_the_others_have() -> None:
    """Of both sides together, to the bit."""
    generator = torch.Generator().manual_seed(2)
    cost = torch.randn(4, generator=generator, dtype=torch.float64)
    products = torch.randn(4, UNKNOWNS + 1, UNKNOWNS, generator=generator, dtype=torch.float64)
    ones = torch.ones(4, dtype=torch.float64)
    alone = Blocks.join([PackedBlocks.of_sorted(index_of([100]), 1).blocks] * 2)
    beside = Blocks.join([PackedBlocks.of_sorted(index_of([100, 1000]), 2).blocks] * 2)
    own = (beside.owner == 0).nonzero()[:, 0]
    many = len(beside.owner)
    wide_cost = torch.full((many,), torch.nan, dtype=torch.float64).index_copy(0, own, cost)
    wide = torch.full((many, *products.shape[1:]), torch.nan, dtype=torch.float64).index_copy(0, own, products)
    weight = torch.ones(many, dtype=torch.float64)
    sums = WeightedBlocks.of(alone, ones).sums([BlockParts(cost, products)])
    beside_sums = WeightedBlocks.of(beside, weight).sums([BlockParts(wide_cost, wide)])
    for x, y in zip(sums, beside_sums, strict=True):
        assert torch.equal(x[0], y[0])
        assert not torch.isfinite(y[1]).any()


def test_products_of_single_precision_rows_leave_in_double() -> None:
    J, first, second, _ = (x.float() for x in rows_of([64]))
    products = weighted_products(J[None], first[None], second[None])
    assert products.dtype == torch.float64
    exact = weighted_products(*(x.double()[None] for x in (J, first, second)))
    torch.testing.assert_close(products, exact, rtol=1e-5, atol=1e-4)
    assert products.shape == (1, UNKNOWNS + 1, UNKNOWNS)
