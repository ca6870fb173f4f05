"""Blocks of 64 rows: layout, joining, leaving objects out, and their sums, against loops over rows."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from directshape_torch.tracking.blocks import (
    Blocks,
    ObjectSums,
    PackedBlocks,
    object_sums,
    sums_by_table,
    table_to_compile,
    weighted_products,
)

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


def as_compiled(weight: Tensor, of_object: Tensor, cost: Tensor, products: Tensor) -> ObjectSums:
    table = table_to_compile(of_object, len(weight))
    return sums_by_table(weight, table, cost, products).of_first(len(of_object))


FORMS = [pytest.param(object_sums, id="eager"), pytest.param(as_compiled, id="as_compiled")]
Form = Callable[[Tensor, Tensor, Tensor, Tensor], ObjectSums]


def sums_of(form: Form, packed: PackedBlocks, rows: tuple[Tensor, ...], weight: Tensor) -> ObjectSums:
    """Sums over objects of what the rows of `packed` hold, its empty places without a weight."""
    J, first, second, cost = (x[packed.rows] for x in rows)
    first, second, cost = (torch.where(packed.filled, x, torch.zeros_like(x)) for x in (first, second, cost))
    owner = packed.blocks.owner
    return form(weight[owner], packed.blocks.of_object, cost.sum(dim=1), weighted_products(J, first, second))


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


def weights(num_objects: int) -> Tensor:
    return torch.arange(1, num_objects + 1, dtype=torch.float64)


def assert_same(found: tuple[Tensor, ...], expected: tuple[Tensor, ...]) -> None:
    for x, y in zip(found, expected, strict=True):
        torch.testing.assert_close(x, y, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("counts", [counts for counts in COUNTS if sum(counts)])
def test_sums_against_a_loop(counts: list[int], form: Form) -> None:
    index, rows = index_of(counts), rows_of(counts)
    weight = weights(len(counts))
    assert_same(sums_of(form, PackedBlocks.of_sorted(index, len(counts)), rows, weight), looped(index, rows, weight))


@pytest.mark.parametrize("counts", COUNTS)
def test_every_row_has_one_place_and_empty_places_repeat_their_own_object(counts: list[int]) -> None:
    index = index_of(counts)
    packed = PackedBlocks.of_sorted(index, len(counts))
    assert packed.rows[packed.filled].tolist() == list(range(len(index)))
    assert torch.equal(index[packed.rows], packed.blocks.owner[:, None].expand_as(packed.rows))
    assert len(packed.blocks.owner) == sum(-(-count // 64) for count in counts)
    width = packed.blocks.of_object.shape[1]
    assert width & (width - 1) == 0
    for b in range(len(counts)):
        own = [m for m in packed.blocks.of_object[b].tolist() if m < len(packed.blocks.owner)]
        assert own == (packed.blocks.owner == b).nonzero()[:, 0].tolist()


LEFT, RIGHT = [130, 0, 64, 3], [5, 70, 0, 300]


def _joined() -> tuple[Blocks, list[PackedBlocks]]:
    parts = [PackedBlocks.of_sorted(index_of(counts), 4) for counts in (LEFT, RIGHT)]
    return Blocks.join([part.blocks for part in parts]), parts


def _of_both(form: Form, blocks: Blocks, parts: list[PackedBlocks], weight: Tensor) -> ObjectSums:
    costs, products = [], []
    for number, (packed, counts) in enumerate(zip(parts, (LEFT, RIGHT), strict=True)):
        J, first, second, cost = (x[packed.rows] for x in rows_of(counts, number))
        first, second, cost = (torch.where(packed.filled, x, torch.zeros_like(x)) for x in (first, second, cost))
        costs.append(cost.sum(dim=1))
        products.append(weighted_products(J, first, second))
    return form(weight[blocks.owner], blocks.of_object, torch.cat(costs), torch.cat(products))


@pytest.mark.parametrize("form", FORMS)
def test_joined_blocks_add_what_their_parts_give(form: Form) -> None:
    blocks, parts = _joined()
    weight = weights(4)
    each = [looped(index_of(counts), rows_of(counts, n), weight) for n, counts in enumerate((LEFT, RIGHT))]
    assert_same(_of_both(form, blocks, parts, weight), tuple(a + b for a, b in zip(*each, strict=True)))
    assert blocks.owner.tolist() == [0, 0, 0, 2, 3, 0, 1, 1, 3, 3, 3, 3, 3]


def test_one_part_joined_is_itself() -> None:
    blocks = PackedBlocks.of_sorted(index_of(LEFT), 4).blocks
    joined = Blocks.join([blocks])
    assert torch.equal(joined.owner, blocks.owner)
    assert torch.equal(joined.of_object, blocks.of_object)
    assert joined.counts == blocks.counts


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("keep", [[0, 1, 2, 3], [0, 3], [1], [2, 3]])
def test_objects_that_leave_take_their_blocks_along(keep: list[int], form: Form) -> None:
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
    all_of_them = form(weight[blocks.owner], blocks.of_object, cost, products)
    some = form(weight[kept][fewer.owner], fewer.of_object, cost[chosen], products[chosen])
    for x, y in zip(some, all_of_them, strict=True):
        assert torch.equal(x, y[kept])
    assert len(parts) == 2


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("own_rows", [100, 250, 500])
def test_an_objects_sums_do_not_depend_on_how_many_blocks_the_others_have(own_rows: int, form: Form) -> None:
    """Of both sides together, to the bit: `of_object` is wider beside a large object."""
    generator = torch.Generator().manual_seed(2)
    alone = Blocks.join([PackedBlocks.of_sorted(index_of([own_rows]), 1).blocks] * 2)
    beside = Blocks.join([PackedBlocks.of_sorted(index_of([own_rows, 2000]), 2).blocks] * 2)
    count = len(alone.owner)
    cost = torch.randn(count, generator=generator, dtype=torch.float64)
    products = torch.randn(count, UNKNOWNS + 1, UNKNOWNS, generator=generator, dtype=torch.float64)
    ones = torch.ones(count, dtype=torch.float64)
    assert beside.of_object.shape[1] > alone.of_object.shape[1]
    own = (beside.owner == 0).nonzero()[:, 0]
    many = len(beside.owner)
    wide_cost = torch.full((many,), torch.nan, dtype=torch.float64).index_copy(0, own, cost)
    wide = torch.full((many, *products.shape[1:]), torch.nan, dtype=torch.float64).index_copy(0, own, products)
    weight = torch.ones(many, dtype=torch.float64)
    of_one, of_both = form(ones, alone.of_object, cost, products), form(weight, beside.of_object, wide_cost, wide)
    for x, y in zip(of_one, of_both, strict=True):
        assert torch.equal(x[0], y[0])
        assert not torch.isfinite(y[1]).any()


@pytest.mark.parametrize(("size", "expected"), [((1, 1), (2, 2, 8)), ((5, 4), (5, 2, 8)), ((3, 64), (3, 8, 8))])
def test_tables_to_compile_have_no_size_that_would_be_compiled_anew(
    size: tuple[int, int], expected: tuple[int, int, int]
) -> None:
    table = table_to_compile(torch.arange(size[0] * size[1]).view(size), 1000)
    assert table.shape == expected
    assert torch.equal(table[: size[0]].flatten(1)[:, : size[1]], torch.arange(size[0] * size[1]).view(size))
    assert int((table == 1000).sum()) == table.numel() - size[0] * size[1]


def test_nothing_at_all_adds_up_to_nothing() -> None:
    blocks = PackedBlocks.of_sorted(index_of([0, 0]), 2).blocks
    sums = object_sums(
        torch.empty(0), blocks.of_object, torch.empty(0).double(), torch.empty(0, UNKNOWNS + 1, UNKNOWNS).double()
    )
    assert [x.tolist() for x in sums[:2]] == [[0.0, 0.0], [[0.0] * UNKNOWNS] * 2]


def test_products_of_single_precision_rows_leave_in_double() -> None:
    J, first, second, _ = (x.float() for x in rows_of([64]))
    products = weighted_products(J[None], first[None], second[None])
    assert products.dtype == torch.float64
    exact = weighted_products(*(x.double()[None] for x in (J, first, second)))
    torch.testing.assert_close(products, exact, rtol=1e-5, atol=1e-4)
    assert products.shape == (1, UNKNOWNS + 1, UNKNOWNS)
