"""What belongs to some cars follows from the axes that fields declare, through tables in tables."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import pytest
import torch
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.numerics.records import Dense, declared
from directshape_torch.numerics.tables import Chosen, Table, joined
from directshape_torch.rows import Blocks

CARS = Chosen(torch.tensor([False, True, False, True]), [1, 3])
BLOCKS = Blocks(torch.tensor([3, 1, 0, 3, 2]), (1, 1, 1, 2))


class Rowwise(NamedTuple):
    """Values of blocks, of which only a table around it knows the cars."""

    points: Annotated[Tensor, Dense(3, "M", 2)]
    table: Tensor | None = None


@dataclass(frozen=True)
class Term(Table):
    """A table with blocks, values of blocks in a table and in a tuple, and values that all cars share."""

    blocks: Blocks
    inner: Rowwise
    several: tuple[Rowwise, ...]
    offset: Annotated[Tensor | None, Dense("B")]
    counts: Annotated[tuple[int, ...], Dense("B")]
    bounds: Annotated[Tensor, Dense(4, "N")]


def table() -> Term:
    points = torch.arange(30.0).view(3, 5, 2)
    return Term(BLOCKS, Rowwise(points), (Rowwise(-points), Rowwise(2 * points)), None, (5, 6, 7, 8), torch.rand(4, 4))


def test_rows_of_cars_and_of_their_blocks_remain_and_owners_get_new_numbers() -> None:
    whole = table()
    few, kept = whole.of(CARS), [0, 1, 3]
    assert few.blocks.owner.tolist() == [1, 0, 1]
    assert few.blocks.counts == (1, 2)
    assert few.counts == (6, 8)
    assert few.offset is None
    for part, before in zip((few.inner, *few.several), (whole.inner, *whole.several), strict=True):
        assert torch.equal(part.points, before.points[:, kept])
    assert few.bounds is whole.bounds
    assert few.blocks.kept(Chosen(torch.tensor([True, False]), [0])).tolist() == [1]


def test_tables_are_joined_car_after_car() -> None:
    whole = table()
    parts = [whole.of(CARS), whole.of(Chosen.where(torch.tensor([True, True, False, False])))]
    both = joined(parts, [2, 2])
    assert both.blocks.owner.tolist() == [1, 0, 1, 3, 2]
    assert both.blocks.counts == (1, 2, 1, 1)
    assert both.counts == (6, 8, 5, 6)
    assert both.offset is None
    for part, before in zip((both.inner, *both.several), (whole.inner, *whole.several), strict=True):
        assert torch.equal(part.points, before.points[:, [0, 1, 3, 1, 2]])
    assert both.bounds is whole.bounds
    assert joined([whole], [4]).blocks.owner.tolist() == BLOCKS.owner.tolist()


def test_types_that_only_a_type_checker_imports_are_named() -> None:
    @dataclass(frozen=True)
    class Unfinished(Table):
        folder: NowhereImported  # type: ignore[name-defined]  # noqa: F821

    with pytest.raises(InputError, match=r"Unfinished: .*NowhereImported.*outside of TYPE_CHECKING"):
        declared(Unfinished(None))
