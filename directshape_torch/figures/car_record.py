"""Dataclasses with one row a car: chosen, placed among others, moved, and as flat tensors for files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import Field, fields, replace
from typing import Any, Self, get_type_hints

import torch
from torch import Tensor

from directshape_torch.errors import InputError, shown
from directshape_torch.numerics.checks import Record, check_declared, check_shape, check_stored


class CarRecord(Record):
    """Base of records of tensors (B, ...), one row a car, of such records, and of words and other values.

    Examples:
        >>> from dataclasses import dataclass
        >>> @dataclass(frozen=True)
        ... class Depths(CarRecord):
        ...     depth_m: Tensor
        >>> Depths(torch.tensor([10.0, 20.0])).rows(torch.tensor([1]))
        Depths(depth_m=tensor([20.]))
    """

    def rows(self, index: Tensor) -> Self:
        """The cars `index` (M,), in that order."""
        return self._with(lambda value: value[index.to(value.device)], by_row=True)

    def spread(self, rows: Tensor, count: int) -> Self:
        """The cars `rows` (B,), ascending, placed among `count` cars; NaN for the others."""
        return self._with(lambda value: placed(value, rows, count), by_row=True)

    def where(self, condition: Tensor) -> Self:
        """A copy with NaN for the cars where the condition (B,) does not hold."""
        return self._with(lambda value: kept(value, condition), by_row=True)

    def put(self, rows: Tensor, others: Self) -> Self:
        """A copy with the cars `rows` (R,) replaced; figures of another width stay as they are."""
        changed: dict[str, Any] = {}
        for (each, value), (_, other) in zip(self._fields(), others._fields(), strict=True):
            if isinstance(value, CarRecord):
                changed[each.name] = value.put(rows, other)
            elif isinstance(value, Tensor) and each.name not in self.shared and value.shape[1:] == other.shape[1:]:
                changed[each.name] = value.index_copy(0, rows, other)
        return replace(self, **changed)  # type: ignore[type-var]

    def state_dict(self, prefix: str = "") -> dict[str, Tensor]:
        """All tensors and words by flat names, as `torch.save` and safetensors take them; words are UTF-8 bytes."""
        state: dict[str, Tensor] = {}
        for each, value in self._fields():
            if isinstance(value, CarRecord):
                state |= value.state_dict(f"{prefix}{each.name}.")
            elif isinstance(value, tuple):
                state[prefix + each.name] = torch.tensor(list("\n".join(value).encode()), dtype=torch.uint8)
            elif isinstance(value, bool):
                state[prefix + each.name] = torch.tensor(value)
            elif isinstance(value, Tensor):
                state[prefix + each.name] = value.detach().clone(memory_format=torch.contiguous_format)
        return state

    @classmethod
    def _from_state(
        cls, state: Mapping[str, Tensor], prefix: str = "", sizes: dict[int | str, int] | None = None, **others: Any
    ) -> Self:
        """The record whose `state_dict` this is; `others` are the fields that are none of its values.

        Raises:
            InputError: a value is missing or is not what its field declares.
        """
        values, sizes = dict(others), {} if sizes is None else sizes
        hints = get_type_hints(cls, include_extras=True)
        for each in fields(cls):  # type: ignore[arg-type]
            kind, name = hints[each.name], prefix + each.name
            if each.name in others:
                continue
            if isinstance(kind, type) and issubclass(kind, CarRecord):
                values[each.name] = kind._from_state(state, f"{name}.", sizes)
            elif name not in state:
                raise InputError("state", f"the tensor {name!r}", f"{len(state)} others", "save result.state_dict()")
            elif kind is bool:
                check_shape(f"state[{name!r}]", state[name], ())
                check_stored(f"state[{name!r}]", state[name])
                values[each.name] = bool(state[name])
            elif hasattr(kind, "__metadata__"):
                check_declared(f"state[{name!r}]", state[name], kind.__metadata__[0], sizes)
                check_stored(f"state[{name!r}]", state[name])
                values[each.name] = state[name]
            else:
                values[each.name] = _words(f"state[{name!r}]", state[name])
        return cls(**values)

    def _fields(self) -> Iterator[tuple[Field[Any], Any]]:
        return ((each, getattr(self, each.name)) for each in fields(self))  # type: ignore[arg-type]


def _words(name: str, letters: Tensor) -> tuple[str, ...]:
    """Words of one line each, from their UTF-8 bytes."""
    check_shape(name, letters, ("n",))
    check_stored(name, letters)
    try:
        text = bytes(letters.tolist()).decode()
    except (TypeError, ValueError) as error:  # numbers that are no bytes, bytes that are no letters
        raise InputError(name, "UTF-8 bytes", shown(letters.tolist()), "save result.state_dict()") from error
    return tuple(text.split("\n")) if text else ()


def placed(values: Tensor, rows: Tensor, count: int) -> Tensor:
    """Figures (R, ...) of the cars `rows` (R,), ascending, among `count` cars; NaN for the others.

    Examples:
        >>> placed(torch.tensor([5.0]), torch.tensor([1]), 2)
        tensor([nan, 5.])
    """
    if len(rows) == count:  # all of them, which is the usual case
        return values
    return values.new_full((count, *values.shape[1:]), torch.nan).index_copy(0, rows, values)


def kept(values: Tensor, condition: Tensor) -> Tensor:
    """The figures (B, ...) of cars where the condition (B,) holds, NaN elsewhere.

    Examples:
        >>> kept(torch.tensor([4.0, 5.0]), torch.tensor([True, False]))
        tensor([4., nan])
    """
    return torch.where(condition.view(-1, *[1] * (values.ndim - 1)), values, torch.nan)
