"""Tables hold values of B cars; each field declares its axes, and the values of some of the cars follow from that.

A table is a named tuple, or a frozen dataclass derived from `Table`. A field `Annotated[Tensor, Dense("B", 3)]` has a
row for each car, and `Annotated[tuple[int, ...], Dense("B")]` has a number for each car that the host knows. Another
axis belongs to cars if the table, or a table in it, has the car of each row: `Annotated[Tensor, Dense("M",
numbers_of="B")]`, as `Blocks` do. All cars share the values of a field without declaration.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, Protocol, Self, TypeVar, cast

import torch
from torch import Tensor

from directshape_torch.numerics.records import Dense, declared

_T = TypeVar("_T")


class _Kept:
    """These are the rows of an axis that remain, in their order: those where `keep` holds."""

    def __init__(self, keep: Tensor, count: int | None) -> None:
        self.keep = keep  # (rows,) bool
        self.count = count  # how many rows remain; None if the host does not know

    @cached_property
    def index(self) -> Tensor:
        """The numbers (remaining,) of the rows that remain."""
        if self.count is None:
            return self.keep.nonzero()[:, 0]
        return torch.nonzero_static(self.keep, size=self.count)[:, 0]

    @cached_property
    def new_number(self) -> Tensor:
        """The new number (rows,) of each row that remains; other entries mean nothing."""
        return torch.cumsum(self.keep.long(), 0) - 1


class Chosen(_Kept):
    """`Chosen` are some of B cars, or of B problems: those where `keep` (B,) holds.

    The value is made once and passed on. The host knows the `numbers` of the chosen cars, so that whatever belongs to
    them is found without waiting for the device.

    Examples:
        >>> Chosen.where(torch.tensor([False, True, True])).numbers
        (1, 2)
    """

    def __init__(self, keep: Tensor, numbers: Sequence[int]) -> None:
        super().__init__(keep, len(numbers))
        self.numbers = tuple(numbers)

    @classmethod
    def where(cls, keep: Tensor) -> Chosen:
        """The cars where `keep` (B,) holds; the host waits for the device."""
        return cls(keep, keep.nonzero()[:, 0].tolist())


class Table(Protocol):
    """`Table` is the base of frozen dataclasses whose fields declare their axes."""

    def of(self, cars: Chosen) -> Self:
        """What the table holds of some of its cars."""
        table: Self = _Cut(self, cars).inside(self)
        return table


def of(value: _T, cars: Chosen) -> _T:
    """What a named tuple, or a tuple of tables, holds of some of its cars."""
    part: _T = _Cut(value, cars).part(value)
    return part


def take_rows(value: _T, index: Tensor, axis: str = "B") -> _T:
    """The rows `index` (R,) of an axis of a table and of tables in it, in that order; numbers of cars stay the same."""

    def taken(part: Tensor, spec: Dense) -> Tensor:
        return part.index_select(spec.shape.index(axis), index) if axis in spec.shape else part

    return _changed(value, taken, lambda part: take_rows(part, index, axis)) if is_table(value) else value


def joined(tables: Sequence[_T], num_cars: Sequence[int]) -> _T:
    """One table of the cars of several tables, first those of the first one, with what all cars share there.

    Args:
        tables: tables of the same kind, in which nothing numbers rows other than cars.
        num_cars: number of cars of each table.
    """
    first_car = [sum(num_cars[:number]) for number in range(len(num_cars))]

    def join(parts: Sequence[Any]) -> Any:
        if isinstance(parts[0], tuple):
            return inside(parts)
        return joined(parts, num_cars) if is_table(parts[0]) else parts[0]

    def inside(parts: Sequence[Any]) -> Any:
        """The first of the parts, with what all have in each of its fields."""
        if type(parts[0]) is tuple:
            return tuple(map(join, zip(*parts, strict=True)))
        names = (name for name in declared(parts[0]) if getattr(parts[0], name) is not None)
        others = iter([[getattr(part, name) for part in parts] for name in names])
        return _changed(parts[0], lambda _, spec: declared_field(next(others), spec), lambda _: join(next(others)))

    def declared_field(values: list[Any], spec: Dense) -> Any:
        if isinstance(values[0], tuple):
            return sum(values, ())
        assert spec.numbers_of in ("", "B"), "rows other than cars are numbered"
        if spec.numbers_of:
            values = [value + first for value, first in zip(values, first_car, strict=True)]
        of_cars = (axis for axis, letter in enumerate(spec.shape) if letter == "B" or _owner(tables[0], str(letter)))
        axis = next(of_cars, None)
        return values[0] if axis is None else torch.cat(values, dim=axis)

    return cast(_T, inside(tables))


def is_table(value: object) -> bool:
    """Whether a value may hold values of cars: a named tuple, a `Table`, or a tuple."""
    return isinstance(value, tuple) or Table in type(value).__mro__


class _Cut:
    """A `_Cut` takes what a table, and the named tuples in it, hold of some cars; it asks the tables in it to do so."""

    def __init__(self, table: object, cars: Chosen) -> None:
        self.table, self.cars = table, cars
        self.known: dict[int | str, _Kept | None] = {"B": cars}

    def part(self, value: Any) -> Any:
        """The part of the chosen cars in a value of any kind."""
        if isinstance(value, tuple):
            return self.inside(value)
        return value.of(self.cars) if is_table(value) else value

    def inside(self, table: Any) -> Any:
        return _changed(table, self._declared, self.part)

    def _declared(self, part: Any, spec: Dense) -> Any:
        if isinstance(part, tuple):
            return tuple(part[number] for number in self.cars.numbers)
        for axis, letter in enumerate(spec.shape):
            if (rows := self._rows(letter)) is not None:
                part = part.index_select(axis, rows.index)
        numbered = self._rows(spec.numbers_of)
        return part if numbered is None else numbered.new_number[part]

    def _rows(self, axis: int | str) -> _Kept | None:
        """The rows of an axis that remain; None for an axis that does not belong to cars."""
        if axis not in self.known:
            self.known[axis] = None
            if isinstance(axis, str) and (owner := _owner(self.table, axis)) is not None:
                car, counts = owner
                count = sum(counts[n] for n in self.cars.numbers) if isinstance(counts, tuple) else None
                self.known[axis] = _Kept(self.cars.keep[car], count)
        return self.known[axis]


def _owner(table: object, axis: str) -> tuple[Tensor, object] | None:
    """The car of each row of an axis, and how many rows each car has, from a table or from tables in it."""
    specs = declared(table)
    for name, spec in specs.items():
        if spec is not None and spec.shape == (axis,) and spec.numbers_of == "B":
            return getattr(table, name), getattr(table, "counts", None)
    # Blocks come first, because the host knows how many of them each car has.
    parts = getattr(table, "blocks", None), *(getattr(table, name) for name, spec in specs.items() if spec is None)
    found = (_owner(part, axis) for part in parts if is_table(part))
    return next((owner for owner in found if owner is not None), None)


def _changed(value: Any, of_declared: Callable[[Any, Dense], Any], of_other: Callable[[Any], Any]) -> Any:
    """A copy of a table, or of a tuple of tables, in which each field is changed by one of two functions."""
    if type(value) is tuple:
        return tuple(map(of_other, value))
    changed: dict[str, Any] = {}
    for name, spec in declared(value).items():
        part = getattr(value, name)
        if part is not None:
            changed[name] = of_other(part) if spec is None else of_declared(part, spec)
    changed = {name: part for name, part in changed.items() if part is not getattr(value, name)}
    if not changed:
        return value
    return value._replace(**changed) if hasattr(value, "_replace") else replace(value, **changed)
