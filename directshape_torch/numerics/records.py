"""Records of tensors are moved, cut and stored as a whole; each field declares what its tensor must be."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from functools import cache
from typing import Any, ClassVar, NamedTuple, Self, get_type_hints

import torch
from torch import Tensor

from directshape_torch.errors import InputError, shown
from directshape_torch.numerics.checks import FOLLOWING, Kind, check_alike, check_shape


class Dense:
    """`Dense` declares what a tensor of a record must be: `Annotated[Tensor, Dense("F", 3, 3)]`.

    Args:
        shape: sizes; a letter is any size, the same one wherever it stands in the record.
        kind: kind of the tensor's numbers.
        cure: advice where the tensor has another shape.
        numbers_of: the letter whose rows the tensor numbers, if it does (see `tables`).
    """

    def __init__(self, *shape: int | str, kind: Kind = "floating", cure: str = "", numbers_of: str = "") -> None:
        self.shape, self.kind, self.cure, self.numbers_of = shape, "index" if numbers_of else kind, cure, numbers_of

    def check(self, name: str, value: Tensor, sizes: dict[int | str, int]) -> None:
        """Raise `InputError` unless a tensor is as declared; `sizes` has the sizes of letters and gets new ones."""
        check_shape(name, value, [sizes.get(size, size) for size in self.shape], self.cure, self.kind)
        sizes |= dict(zip(self.shape, value.shape, strict=True))


def declared(record: object) -> dict[str, Dense | None]:
    """The declaration of each field of a dataclass or a named tuple, None where a field has no declaration."""
    kind: Any = type(record)
    return _declared_by(kind)


@cache
def _declared_by(kind: type) -> dict[str, Dense | None]:
    names = [each.name for each in fields(kind)] if is_dataclass(kind) else getattr(kind, "_fields", ())
    try:
        hints = get_type_hints(kind, include_extras=True) if names else {}
    except NameError as error:
        cure = "import the types of its fields at the top of the module, outside of TYPE_CHECKING"
        raise InputError(kind.__name__, "fields whose types are known at run time", str(error), cure) from error
    marks = {name: getattr(hints.get(name), "__metadata__", ()) for name in names}
    return {name: next((x for x in of_field if isinstance(x, Dense)), None) for name, of_field in marks.items()}


class DeclaredTensor(NamedTuple):
    """A `DeclaredTensor` is a tensor of a record, its name from the outermost record on, and its kind of numbers."""

    name: str
    value: Tensor
    kind: Kind


class Record:
    """`Record` is the base of frozen dataclasses of tensors, further records and other values."""

    # A shared field is one for all rows and is kept where rows are chosen.
    shared: ClassVar[frozenset[str]] = frozenset()

    def to(self, device: torch.device | torch.dtype | str | None = None, dtype: torch.dtype | None = None) -> Self:
        """A copy on another device, and with another dtype of floating-point tensors; a dtype may come alone."""
        if isinstance(device, torch.dtype):
            device, dtype = None, device
        return self._with(lambda x: x.to(device=device, dtype=dtype if x.is_floating_point() else None))

    def cpu(self) -> Self:
        """A copy in the memory of the host."""
        return self.to("cpu")

    def detach(self) -> Self:
        """A copy without gradients."""
        return self._with(Tensor.detach)

    def rows(self, index: Tensor) -> Self:
        """The rows `index` (M,) int64, in that order."""
        chosen: dict[str, Any] = {}
        for each in fields(self):  # type: ignore[arg-type]
            value = getattr(self, each.name)
            if isinstance(value, Record) and each.name not in self.shared:
                chosen[each.name] = value.rows(index)
            elif isinstance(value, Tensor) and each.name not in self.shared:
                chosen[each.name] = value.index_select(0, index.to(value.device))
        return replace(self, **chosen)  # type: ignore[type-var]

    def _with(self, change: Callable[..., Tensor], *others: Self, by_row: bool = False) -> Self:
        """A copy with each tensor changed, together with its counterparts; `by_row` leaves out shared fields."""
        changed: dict[str, Any] = {}
        for each in fields(self):  # type: ignore[arg-type]
            value, *theirs = (getattr(record, each.name) for record in (self, *others))
            if by_row and each.name in self.shared:
                continue
            if isinstance(value, Record):
                changed[each.name] = value._with(change, *theirs, by_row=by_row)
            elif isinstance(value, Tensor):
                changed[each.name] = change(value, *theirs)
        return replace(self, **changed)  # type: ignore[type-var]


class TensorRecord(Record):
    """`TensorRecord` is the base of records whose tensors are declared (by `Dense`) and checked.

    Optional tensors have None as default.

    Raises:
        InputError: a value is no tensor, not dense, or of another shape or kind, or floating-point tensors differ in
            dtype or device.
    """

    def __post_init__(self) -> None:
        sizes: dict[int | str, int] = {}
        first: DeclaredTensor | None = None
        specs = declared(self)
        for each in fields(self):  # type: ignore[arg-type]
            name, value, spec = each.name, getattr(self, each.name), specs[each.name]
            if spec is None or (value is None and each.default is None):
                continue
            spec.check(name, value, sizes)
            if spec.kind in FOLLOWING:
                first = first or DeclaredTensor(name, value, spec.kind)
                check_alike(name, value, first.name, first.value)

    def in_dtype(self, dtype: torch.dtype) -> Self:
        """The record with its numbers, and the numbers of records inside it, in a dtype; masks keep their dtype."""
        changed: dict[str, Any] = {}
        for name, spec in declared(self).items():
            value = getattr(self, name)
            if isinstance(value, TensorRecord):
                changed[name] = value.in_dtype(dtype)
            elif value is not None and spec is not None and spec.kind in FOLLOWING:
                changed[name] = value.to(dtype)
        is_same = all(getattr(self, name) is value for name, value in changed.items())
        return self if is_same else replace(self, **changed)  # type: ignore[type-var]

    def tensors(self, name: str) -> Iterator[DeclaredTensor]:
        """All tensors of the record, which is called `name`, and of records inside it."""
        for field, spec in declared(self).items():
            value = getattr(self, field)
            if isinstance(value, TensorRecord):
                yield from value.tensors(f"{name}.{field}")
            elif spec is not None and value is not None:
                yield DeclaredTensor(f"{name}.{field}", value, spec.kind)

    @classmethod
    def joined(cls, records: Sequence[Self]) -> Self:
        """The rows of several records one after the other; values other than tensors and tuples come from the first."""
        values: dict[str, Any] = {}
        for each in fields(cls):  # type: ignore[arg-type]
            first, *rest = (getattr(record, each.name) for record in records)
            if isinstance(first, TensorRecord):
                first = type(first).joined([first, *rest])
            elif isinstance(first, Tensor):
                first = torch.cat([first, *rest])
            elif isinstance(first, tuple):
                first = tuple(item for part in (first, *rest) for item in part)
            values[each.name] = first
        return cls(**values)


class CarRecord(Record):
    """`CarRecord` is the base of records with one row a car: of tensors (B, ...), `CarRecord`s, words, other values."""

    @classmethod
    @cache
    def _hints(cls) -> dict[str, Any]:
        """The types of the fields by name, with the declarations of tensors."""
        hints = get_type_hints(cls, include_extras=True)
        return {each.name: hints[each.name] for each in fields(cls)}  # type: ignore[arg-type]

    @classmethod
    def nothing(cls, sizes: Mapping[int | str, int], like: Tensor, **known: Any) -> Self:
        """A record whose unknown fields are NaN, and -1 for whole numbers, on the device of `like`.

        Args:
            sizes: sizes of the letters of all shapes.
            like: any tensor.
            known: values of the known fields; fields without a default that are no tensors must be among them.
        """
        values = dict(known)
        for name, kind in cls._hints().items():
            if name in known:
                continue
            if isinstance(kind, type) and issubclass(kind, CarRecord):
                values[name] = kind.nothing(sizes, like)
            elif hasattr(kind, "__metadata__"):
                spec: Dense = kind.__metadata__[0]
                shape = [sizes.get(size, size) for size in spec.shape]
                unknown = -1 if spec.kind == "index" else torch.nan
                dtype = torch.int64 if spec.kind == "index" else torch.float64
                values[name] = torch.full(shape, unknown, dtype=dtype, device=like.device)  # type: ignore[arg-type]
        return cls(**values)

    def where(self, condition: Tensor) -> Self:
        """A copy with NaN for the cars where the condition (B,) does not hold."""
        return self._with(lambda value: kept(value, condition), by_row=True)

    def put(self, rows: Tensor, others: Self) -> Self:
        """A copy with the cars `rows` (R,) replaced; figures of another width become NaN for all other cars."""

        def replaced(value: Tensor, other: Tensor) -> Tensor:
            if value.shape[1:] != other.shape[1:]:
                value = other.new_full((len(value), *other.shape[1:]), torch.nan)
            return value.index_copy(0, rows, other)

        return self._with(replaced, others, by_row=True)

    def state_dict(self, prefix: str = "") -> dict[str, Tensor]:
        """All tensors and words by flat names, for `torch.save` and safetensors; words become UTF-8 bytes."""
        state: dict[str, Tensor] = {}
        for each in fields(self):  # type: ignore[arg-type]
            value, name = getattr(self, each.name), prefix + each.name
            if isinstance(value, CarRecord):
                state |= value.state_dict(f"{name}.")
            elif isinstance(value, tuple):
                state[name] = torch.tensor(list("\n".join(value).encode()), dtype=torch.uint8)
            elif isinstance(value, bool):
                state[name] = torch.tensor(value)
            elif isinstance(value, Tensor):
                state[name] = value.detach().clone(memory_format=torch.contiguous_format)
        return state

    @classmethod
    def _from_state(
        cls, state: Mapping[str, Tensor], prefix: str = "", sizes: dict[int | str, int] | None = None, **others: Any
    ) -> Self:
        """The record whose `state_dict` is `state`; `others` are the fields that `state` does not hold.

        Raises:
            InputError: a value is missing or is not what its field declares.
        """
        values, sizes = dict(others), {} if sizes is None else sizes
        for field, kind in cls._hints().items():
            name = prefix + field
            called = f"state[{name!r}]"
            if field in others:
                continue
            if isinstance(kind, type) and issubclass(kind, CarRecord):
                values[field] = kind._from_state(state, f"{name}.", sizes)
            elif name not in state:
                raise InputError("state", f"the tensor {name!r}", f"{len(state)} others", "save result.state_dict()")
            elif kind is bool:
                check_shape(called, state[name], ())
                values[field] = bool(state[name])
            elif hasattr(kind, "__metadata__"):
                kind.__metadata__[0].check(called, state[name], sizes)
                values[field] = state[name]
            else:
                values[field] = _words(called, state[name])
        return cls(**values)


def _words(name: str, letters: Tensor) -> tuple[str, ...]:
    """Words of one line each, from their UTF-8 bytes."""
    check_shape(name, letters, ("n",))
    try:
        text = bytes(letters.tolist()).decode()
    except (TypeError, ValueError) as error:  # some numbers are no bytes, or some bytes are no letters
        raise InputError(name, "UTF-8 bytes", shown(letters.tolist()), "save result.state_dict()") from error
    return tuple(text.split("\n")) if text else ()


def kept(values: Tensor, condition: Tensor) -> Tensor:
    """The figures (B, ...) of cars where the condition (B,) holds, NaN elsewhere."""
    return torch.where(condition.view(-1, *[1] * (values.ndim - 1)), values, torch.nan)
