"""This module checks arguments at the border of the package."""

from __future__ import annotations

import math
from collections.abc import Sequence
from numbers import Integral, Real
from typing import Literal

import torch
from torch import Tensor

from directshape_torch.errors import InputError, shown
from directshape_torch.numerics.conversion import FLOATING

# Rotations are right up to rounding: calibration files have six digits or more, and float32 has seven.
_ROTATION_TOLERANCE = 1e-3
_WIDEST_PX = 2**31

Kind = Literal["number", "floating", "image", "index", "flags", "mask"]
# Kinds that share one dtype in a call.
FOLLOWING: frozenset[Kind] = frozenset({"floating", "image"})
_INTEGERS = (torch.int32, torch.int64)
_SMALL = (torch.uint8, torch.int8, torch.int16, torch.bool)
# Each kind has its dtypes, a name for them, and the cure. Bytes are no indices, for PyTorch would take them for a mask.
_KINDS: dict[Kind, tuple[tuple[torch.dtype, ...], str, str]] = {
    "number": (FLOATING + _INTEGERS + _SMALL, "real numbers", ""),
    "floating": (FLOATING, "floating point", "convert it with .float() or .double()"),
    "image": (FLOATING, "floating point in [0, 1]", "divide by 255"),
    "index": (_INTEGERS, "int64 or int32", "convert it with .long()"),
    "flags": ((torch.bool,), "bool", "convert it with .bool()"),
    "mask": (
        (*FLOATING, torch.bool),
        "bool, or foreground probabilities in [0, 1] in floating point",
        "divide by 255 where it holds 0..255, and make 0 and 1 bool with .bool()",
    ),
}


def check_shape(
    name: str, tensor: Tensor, expected: Sequence[int | str], cure: str = "", kind: Kind = "number"
) -> None:
    """Raise `InputError` unless `tensor` is a dense tensor of the expected shape and kind, with numbers.

    Letters in `expected` stand for any size.
    """
    wanted = "(" + ", ".join(str(n) for n in expected) + ("," if len(expected) == 1 else "") + ")"
    if not isinstance(tensor, Tensor):
        # Arrays and lists mostly come from a file that was just read.
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
    if tensor.is_meta:
        raise InputError(name, "a tensor with numbers", "one on the device 'meta'", "make it on a device with memory")


def check_alike(name: str, value: Tensor, first_name: str, first: Tensor) -> None:
    """Raise `InputError` unless a tensor has the dtype and device of the first one of its kind."""
    for what in ("dtype", "device"):
        wanted, got = getattr(first, what), getattr(value, what)
        if wanted != got:
            raise InputError(name, f"the {what} of {first_name} ({wanted})", str(got), "move them together with .to()")


def check_positive(name: str, value: object, cure: str = "") -> None:
    """Raise `InputError` unless `value` is a finite number above 0."""
    try:
        fits = isinstance(value, Real) and not isinstance(value, bool) and 0 < float(value) < math.inf
    except OverflowError:  # a whole number that no float holds
        fits = False
    if not fits:
        raise InputError(name, "a finite number above 0", shown(value), cure)


def check_size_wh(name: str, size: object) -> None:
    """Raise `InputError` unless `size` is a width and a height in whole pixels."""
    sides = size if isinstance(size, Sequence) and len(size) == 2 else ()
    if not sides or not all(isinstance(n, Integral) and 0 < int(n) <= _WIDEST_PX for n in sides):
        raise InputError(name, f"(width, height) in pixels, whole, from 1 to {_WIDEST_PX}", shown(size))


def check_type(name: str, value: object, kinds: tuple[type, ...]) -> None:
    """Raise `InputError` unless `value` has one of the types, of which the message names the first."""
    if not isinstance(value, kinds):
        raise InputError(name, f"a {kinds[0].__name__}", type(value).__name__)


def check_words(name: str, words: object, count: int, what: str) -> None:
    """Raise `InputError` unless there are `count` words, which messages call `what`."""
    if not isinstance(words, (tuple, list)) or not all(isinstance(word, str) for word in words):
        raise InputError(name, f"a tuple of {count} {what}", type(words).__name__)
    if len(words) != count:
        raise InputError(name, f"{count} {what}", f"{len(words)}")


def is_no_rotation(
    transform: Tensor,  # (N, 4, 4), finite
) -> Tensor:  # (N,) bool
    """Where the upper left part of a transform is no rotation."""
    rotation = transform.detach()[:, :3, :3].double()
    error = (rotation @ rotation.mT - torch.eye(3, dtype=torch.float64, device=rotation.device)).abs().amax(dim=(1, 2))
    wrong: Tensor = (error > _ROTATION_TOLERANCE) | (torch.linalg.det(rotation) < 0)
    return wrong


def check_rotation(
    name: str,
    transform: Tensor,  # (N, 4, 4), finite
) -> None:
    """Raise `InputError` unless the upper left part of every transform is a rotation."""
    cure = "leave scale out of the transform, and build it from a rotation matrix in float32 or float64"
    expected = "rotations R with R R^T = I and determinant 1"
    check_rows(name, is_no_rotation(transform), transform[:, :3, :3], expected, cure)


def check_rows(name: str, wrong: Tensor, values: Tensor, expected: str, cure: str = "") -> None:
    """Raise `InputError` that shows the first of the rows (N, ...) that are wrong (N,), if there are any."""
    if bool(wrong.any()):
        row = int(wrong.int().argmax())
        raise InputError(name, expected, f"{values[row].tolist()} in row {row}", cure)


def check_finite(name: str, tensor: Tensor, cure: str = "") -> None:
    """Raise `InputError` for a tensor with NaN or infinity."""
    if not bool(tensor.isfinite().all()):
        raise InputError(name, "finite numbers", "NaN or infinity", cure)
