"""Dataclasses whose tensors say what they must be: shape, kind of numbers; checked when one is made."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, replace
from functools import cache
from typing import Any, NamedTuple, Self, get_type_hints

import torch
from torch import Tensor

from directshape_torch.numerics.checks import FOLLOWING, Kind, check_alike, check_shape, check_stored


class Dense:
    """What a tensor of a `TensorRecord` must be: `Annotated[Tensor, Dense("F", 3, 3)]`.

    Args:
        shape: sizes; a letter is any size, the same one wherever it stands in the record.
        kind: of its numbers.
        cure: what to do where the shape is another one.
    """

    def __init__(self, *shape: int | str, kind: Kind = "floating", cure: str = "") -> None:
        self.shape, self.kind, self.cure = shape, kind, cure


class DeclaredTensor(NamedTuple):
    """A tensor of a record, its name from the outermost record on, and the kind of its numbers."""

    name: str
    value: Tensor
    kind: Kind


class TensorRecord:
    """Base of frozen dataclasses of tensors (`Dense`; optional ones have None as default), such records, other values.

    Raises:
        InputError: a tensor is none, not dense, or of another shape or kind; floating-point ones differ in dtype or
            device.

    Example:
        >>> from directshape_torch.scene import GroundPlane
        >>> GroundPlane(torch.zeros(5, 3), torch.ones(4), ("file",) * 5)
        Traceback (most recent call last):
        ...
        directshape_torch.errors.InputError: offset: expected shape (5,), got (4,)
    """

    def __post_init__(self) -> None:
        sizes: dict[int | str, int] = {}
        first: DeclaredTensor | None = None
        for name, (spec, is_optional) in self._declared().items():
            value = getattr(self, name)
            if value is None and is_optional:
                continue
            check_shape(name, value, [sizes.get(size, size) for size in spec.shape], spec.cure, spec.kind)
            sizes |= dict(zip(spec.shape, value.shape, strict=True))
            if spec.kind in FOLLOWING:
                first = first or DeclaredTensor(name, value, spec.kind)
                check_alike(name, value, first.name, first.value)
            check_stored(name, value)

    @classmethod
    @cache
    def _declared(cls) -> dict[str, tuple[Dense, bool]]:
        """The tensors by name: what they must be, and whether None will do."""
        hints = get_type_hints(cls, include_extras=True)
        return {
            each.name: (spec, each.default is None)
            for each in fields(cls)  # type: ignore[arg-type]
            for spec in getattr(hints[each.name], "__metadata__", ())
            if isinstance(spec, Dense)
        }

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Self:
        """A copy on another device and, for floating-point fields, of another dtype."""

        def convert(value: Any) -> Any:
            if isinstance(value, Tensor):
                return value.to(device=device, dtype=dtype if value.is_floating_point() else None)
            return value.to(device=device, dtype=dtype) if isinstance(value, TensorRecord) else value

        changed = {each.name: convert(getattr(self, each.name)) for each in fields(self)}  # type: ignore[arg-type]
        return replace(self, **changed)  # type: ignore[type-var]

    def tensors(self, name: str) -> Iterator[DeclaredTensor]:
        """All tensors of the record, named `name`, and of those in it."""
        declared = self._declared()
        for each in fields(self):  # type: ignore[arg-type]
            value = getattr(self, each.name)
            if isinstance(value, TensorRecord):
                yield from value.tensors(f"{name}.{each.name}")
            elif each.name in declared and value is not None:
                yield DeclaredTensor(f"{name}.{each.name}", value, declared[each.name][0].kind)
