"""Checks of arguments at the border of the package."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from directshape_torch.errors import InputError


def check_shape(name: str, tensor: Tensor, expected: Sequence[int | str], cure: str = "") -> None:
    """Raise `InputError` unless `tensor` has the expected shape; letters stand for any size.

    Example:
        >>> import torch
        >>> check_shape("points", torch.zeros(7, 3), ("P", 3))
    """
    fits = tensor.ndim == len(expected) and all(
        isinstance(want, str) or want == have for want, have in zip(expected, tensor.shape, strict=True)
    )
    if not fits:
        wanted = "(" + ", ".join(str(n) for n in expected) + ")"
        raise InputError(name, f"shape {wanted}", f"{tuple(tensor.shape)}", cure)
