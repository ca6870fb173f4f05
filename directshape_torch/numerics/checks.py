"""Checks of arguments at the border of the package, and records of tensors that are checked when one is made."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields, replace
from functools import cache
from numbers import Integral, Real
from typing import Any, ClassVar, Literal, NamedTuple, Self, get_type_hints

import torch
from torch import Tensor

from directshape_torch.errors import InputError, shown

# Calibration files have six digits or more, and float32 seven.
_ROTATION_TOLERANCE = 1e-3
_WIDEST_PX = 2**31

Kind = Literal["number", "floating", "image", "index", "flags", "mask"]
# Kinds that share one dtype in a call.
FOLLOWING: frozenset[Kind] = frozenset({"floating", "image"})
_FLOATING = (torch.float32, torch.float64, torch.float16, torch.bfloat16)
_INTEGERS = (torch.int32, torch.int64)
_SMALL = (torch.uint8, torch.int8, torch.int16, torch.bool)
# Dtypes, in words, and the cure. Bytes do not index: they would be taken for a mask.
_KINDS: dict[Kind, tuple[tuple[torch.dtype, ...], str, str]] = {
    "number": (_FLOATING + _INTEGERS + _SMALL, "real numbers", ""),
    "floating": (_FLOATING, "floating point", "convert it with .float() or .double()"),
    "image": (_FLOATING, "floating point in [0, 1]", "divide by 255"),
    "index": (_INTEGERS, "int64 or int32", "convert it with .long()"),
    "flags": ((torch.bool,), "bool", "convert it with .bool()"),
    "mask": (
        (*_FLOATING, torch.bool),
        "bool, or foreground probabilities in [0, 1] in floating point",
        "divide by 255 where it holds 0..255, and make 0 and 1 bool with .bool()",
    ),
}


def check_shape(
    name: str, tensor: Tensor, expected: Sequence[int | str], cure: str = "", kind: Kind = "number"
) -> None:
    """Raise `InputError` unless `tensor` is a dense tensor of the expected shape and kind; letters stand for any size.

    Examples:
        >>> import torch
        >>> check_shape("points", torch.zeros(7, 3), ("P", 3))
    """
    wanted = "(" + ", ".join(str(n) for n in expected) + ("," if len(expected) == 1 else "") + ")"
    if not isinstance(tensor, Tensor):
        # Arrays and lists come from whoever has just read a file.
        made = cure if tensor is None else "make one with torch.as_tensor or torch.stack"
        raise InputError(name, f"a tensor of shape {wanted}", type(tensor).__name__, made)
    if tensor.is_nested or tensor.layout != torch.strided:
        got = "a nested one" if tensor.is_nested else str(tensor.layout)
        raise InputError(name, "a dense tensor (torch.strided)", got, "convert it with .to_dense()")
    fits = tensor.ndim == len(expected) and all(
        isinstance(want, str) or want == have for want, have in zip(expected, tensor.shape, strict=True)
    )
    if not fits:
        raise InputError(name, f"shape {wanted}", f"{tuple(tensor.shape)}", cure)
    dtypes, words, conversion = _KINDS[kind]
    if tensor.dtype not in dtypes:
        raise InputError(name, words, str(tensor.dtype), conversion)


def check_alike(name: str, value: Tensor, first_name: str, first: Tensor) -> None:
    """Raise `InputError` unless a tensor has the dtype and device of the first one of its kind."""
    for what in ("dtype", "device"):
        wanted, got = getattr(first, what), getattr(value, what)
        if wanted != got:
            raise InputError(name, f"the {what} of {first_name} ({wanted})", str(got), "move them together with .to()")


def check_stored(name: str, tensor: Tensor) -> None:
    """Raise `InputError` for a tensor on the device "meta", which has no numbers."""
    if tensor.is_meta:
        raise InputError(name, "a tensor with numbers", "one on the device 'meta'", "make it on a device with memory")


def check_positive(name: str, value: object, cure: str = "") -> None:
    """Raise `InputError` unless `value` is a finite number above 0.

    Examples:
        >>> check_positive("height_m", 1.65)
    """
    try:
        fits = isinstance(value, Real) and not isinstance(value, bool) and 0 < float(value) < math.inf
    except OverflowError:  # a whole number that no float holds
        fits = False
    if not fits:
        raise InputError(name, "a finite number above 0", shown(value), cure)


def check_size_wh(name: str, size: object) -> None:
    """Raise `InputError` unless `size` is a width and a height in whole pixels.

    Examples:
        >>> check_size_wh("size_wh", (1242, 375))
    """
    sides = size if isinstance(size, Sequence) and len(size) == 2 else ()
    if not sides or not all(isinstance(n, Integral) and 0 < int(n) <= _WIDEST_PX for n in sides):
        raise InputError(name, f"(width, height) in pixels, whole, from 1 to {_WIDEST_PX}", shown(size))


def check_type(name: str, value: object, kinds: tuple[type, ...]) -> None:
    """Raise `InputError` unless `value` is of one of some types, the first of which is named."""
    if not isinstance(value, kinds):
        raise InputError(name, f"a {kinds[0].__name__}", type(value).__name__)


def is_no_rotation(
    transform: Tensor,  # (N, 4, 4), finite
) -> Tensor:  # (N,) bool
    """Where the upper left part of a transform is no rotation.

    Examples:
        >>> import torch
        >>> is_no_rotation(torch.diag(torch.tensor([1.0, 1.0, -1.0, 1.0]))[None])
        tensor([True])
    """
    rotation = transform.detach()[:, :3, :3].double()
    error = (rotation @ rotation.mT - torch.eye(3, dtype=torch.float64, device=rotation.device)).abs().amax(dim=(1, 2))
    wrong: Tensor = (error > _ROTATION_TOLERANCE) | (torch.linalg.det(rotation) < 0)
    return wrong


def check_rotation(
    name: str,
    transform: Tensor,  # (N, 4, 4), finite
) -> None:
    """Raise `InputError` unless the upper left part of every transform is a rotation.

    Examples:
        >>> import torch
        >>> check_rotation("T_cam_obj", torch.eye(4)[None])
    """
    wrong = is_no_rotation(transform)
    if wrong.any():
        row = int(wrong.int().argmax())
        rotation = transform.detach()[:, :3, :3].double()
        raise InputError(
            name,
            "rotations R with R R^T = I and determinant 1",
            f"R = {rotation[row].tolist()} in row {row}",
            "leave scale out of the transform, and build it from a rotation matrix",
        )


def check_sigmas(
    name: str,
    sigma: Tensor,  # (N, M)
) -> None:
    """Raise `InputError` unless every standard deviation is above 0; infinity is.

    Examples:
        >>> import torch
        >>> check_sigmas("pose_sigma", torch.tensor([[0.5, torch.inf]]))
    """
    wrong = (~(sigma.detach() > 0)).nonzero().tolist()
    if wrong:
        row, column = wrong[0]
        got = f"{float(sigma[row, column]):g} in row {row}"
        raise InputError(name, "standard deviations above 0", got, "give infinity for what the detector does not know")


class Dense:
    """What a tensor of a `TensorRecord` must be: `Annotated[Tensor, Dense("F", 3, 3)]`.

    Args:
        shape: sizes; a letter is any size, the same one wherever it stands in the record.
        kind: of its numbers.
        cure: what to do where the shape is another one.
    """

    def __init__(self, *shape: int | str, kind: Kind = "floating", cure: str = "") -> None:
        self.shape, self.kind, self.cure = shape, kind, cure


def check_declared(name: str, value: Tensor, spec: Dense, sizes: dict[int | str, int]) -> None:
    """Raise `InputError` unless a tensor is what its field declares; `sizes` are those of the letters, and grow."""
    check_shape(name, value, [sizes.get(size, size) for size in spec.shape], spec.cure, spec.kind)
    sizes |= dict(zip(spec.shape, value.shape, strict=True))


class DeclaredTensor(NamedTuple):
    """A tensor of a record, its name from the outermost record on, and the kind of its numbers."""

    name: str
    value: Tensor
    kind: Kind


class Record:
    """Base of frozen dataclasses of tensors, of further such records, and of other values."""

    # Fields that are one for all rows: kept where rows are chosen.
    shared: ClassVar[frozenset[str]] = frozenset()

    def to(self, device: torch.device | torch.dtype | str | None = None, dtype: torch.dtype | None = None) -> Self:
        """A copy on another device and, for floating-point tensors, of another dtype, which may come alone."""
        if isinstance(device, torch.dtype):
            device, dtype = None, device
        return self._with(lambda x: x.to(device=device, dtype=dtype if x.is_floating_point() else None))

    def cpu(self) -> Self:
        """A copy in the memory of the host."""
        return self.to("cpu")

    def detach(self) -> Self:
        """A copy without gradients."""
        return self._with(Tensor.detach)

    def _with(self, change: Callable[[Tensor], Tensor], by_row: bool = False) -> Self:
        """A copy with all tensors changed; `by_row`, but those that are shared."""
        changed: dict[str, Any] = {}
        for each in fields(self):  # type: ignore[arg-type]
            value = getattr(self, each.name)
            if isinstance(value, Record):
                changed[each.name] = value._with(change, by_row)
            elif isinstance(value, Tensor) and not (by_row and each.name in self.shared):
                changed[each.name] = change(value)
        return replace(self, **changed)  # type: ignore[type-var]


class TensorRecord(Record):
    """Base of records whose tensors are declared (`Dense`; optional ones have None as default) and checked.

    Raises:
        InputError: a tensor is none, not dense, or of another shape or kind; floating-point ones differ in dtype or
            device.

    Examples:
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
            check_declared(name, value, spec, sizes)
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

    def tensors(self, name: str) -> Iterator[DeclaredTensor]:
        """All tensors of the record, named `name`, and of those in it."""
        declared = self._declared()
        for each in fields(self):  # type: ignore[arg-type]
            value = getattr(self, each.name)
            if isinstance(value, TensorRecord):
                yield from value.tensors(f"{name}.{each.name}")
            elif each.name in declared and value is not None:
                yield DeclaredTensor(f"{name}.{each.name}", value, declared[each.name][0].kind)
