"""Checks of arguments at the border of the package."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from directshape_torch.errors import InputError

# Calibration files have six digits or more, and float32 seven.
_ROTATION_TOLERANCE = 1e-3


def check_shape(name: str, tensor: Tensor, expected: Sequence[int | str], cure: str = "") -> None:
    """Raise `InputError` unless `tensor` is a tensor of the expected shape; letters stand for any size.

    Example:
        >>> import torch
        >>> check_shape("points", torch.zeros(7, 3), ("P", 3))
    """
    wanted = "(" + ", ".join(str(n) for n in expected) + ("," if len(expected) == 1 else "") + ")"
    if not isinstance(tensor, Tensor):
        # Arrays and lists come from whoever has just read a file.
        made = "" if tensor is None else "make one with torch.as_tensor or torch.stack"
        raise InputError(name, f"a tensor of shape {wanted}", type(tensor).__name__, cure or made)
    fits = tensor.ndim == len(expected) and all(
        isinstance(want, str) or want == have for want, have in zip(expected, tensor.shape, strict=True)
    )
    if not fits:
        raise InputError(name, f"shape {wanted}", f"{tuple(tensor.shape)}", cure)


def check_integer(name: str, tensor: Tensor) -> None:
    """Raise `InputError` unless `tensor` is int32 or int64, which index others; uint8 would be taken for a mask.

    Example:
        >>> import torch
        >>> check_integer("frame_index", torch.zeros(7, dtype=torch.int64))
    """
    if tensor.dtype not in (torch.int32, torch.int64):
        raise InputError(name, "int64 or int32", str(tensor.dtype), "convert it with .long()")


def check_flags(name: str, tensor: Tensor) -> None:
    """Raise `InputError` unless `tensor` is bool.

    Example:
        >>> import torch
        >>> check_flags("has_mask_left", torch.tensor([True]))
    """
    if tensor.dtype != torch.bool:
        raise InputError(name, "bool", str(tensor.dtype), "convert it with .bool()")


def check_mask_dtype(name: str, masks: Tensor) -> None:
    """Raise `InputError` unless `masks` are bool or floating point.

    Example:
        >>> import torch
        >>> check_mask_dtype("mask_left", torch.zeros(1, 4, 6, dtype=torch.bool))
    """
    if masks.dtype != torch.bool and not masks.is_floating_point():
        raise InputError(
            name,
            "bool, or foreground probabilities in [0, 1] in floating point",
            str(masks.dtype),
            "divide by 255 where it holds 0..255, and make 0 and 1 bool with .bool()",
        )


def is_no_rotation(
    transform: Tensor,  # (N, 4, 4), finite
) -> Tensor:  # (N,) bool
    """Where the upper left part of a transform is no rotation.

    Example:
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

    Example:
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

    Example:
        >>> import torch
        >>> check_sigmas("pose_sigma", torch.tensor([[0.5, torch.inf]]))
    """
    wrong = (~(sigma.detach() > 0)).nonzero().tolist()
    if wrong:
        row, column = wrong[0]
        got = f"{float(sigma[row, column]):g} in row {row}"
        raise InputError(name, "standard deviations above 0", got, "give infinity for what the detector does not know")
