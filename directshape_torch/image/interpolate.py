"""Bilinear lookup in a stack of images, with the exact derivative of that lookup."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.numerics.tensors import take


def bilinear_with_gradient(
    images: Tensor,  # (F, H, W)
    frame_index: Tensor,  # (...), broadcastable to uv's leading axes
    uv: Tensor,  # (..., 2)
    sizes: Tensor | None = None,  # (F, 2)
) -> tuple[Tensor, Tensor, Tensor]:
    """Value of each image at (u, v) and the exact derivative of the bilinear patch there, in one pass.

    The gradient belongs to the cell right and below of a point that lies on a grid line (left and above on the last
    row and column). A coordinate outside the image is clamped to it, where the lookup is constant in that coordinate:
    its derivative is 0. Differentiable by autograd in `images` and `uv`; autograd and the returned gradient agree.

    Args:
        images: (F, H, W), any unit.
        frame_index: integer frame of each point; for neighbourhoods (P, N, 2) give (P, 1).
        uv: (..., 2) pixels, (column, row), centre of the top-left pixel at (0, 0).
        sizes: (F, 2) integer (height, width) of each frame without padding; None: every frame fills (H, W).

    Returns:
        value (...); gradient (..., 2), d value / d (u, v) per pixel; inside (...) bool: the point lies within the
        frame, border pixels' centres included. NaN coordinates are not inside.

    Raises:
        InputError: wrong shapes.

    Examples:
        >>> image = torch.tensor([[[0.0, 2.0], [10.0, 12.0]]])
        >>> value, gradient, inside = bilinear_with_gradient(image, torch.tensor([0]), torch.tensor([[0.5, 0.25]]))
        >>> value, gradient, inside
        (tensor([3.5000]), tensor([[ 2., 10.]]), tensor([True]))
    """
    _check(images, frame_index, uv)
    last_row, last_column = (None, None) if sizes is None else (sizes - 1).unbind(-1)
    height, width = images.shape[1:]
    at = bilinear_patch(
        images.reshape(-1),
        frame_index * (height * width),
        width,
        uv[..., 0],
        uv[..., 1],
        width - 1 if last_column is None else last_column[frame_index],
        height - 1 if last_row is None else last_row[frame_index],
    )
    return at.value, torch.stack([at.d_u, at.d_v], dim=-1), at.inside


class BilinearPatch(NamedTuple):
    """A lookup with its derivatives by the two coordinates."""

    value: Tensor  # (...)
    d_u: Tensor  # (...) per pixel
    d_v: Tensor  # (...) per pixel
    inside: Tensor  # (...) bool


def bilinear_patch(
    pixels: Tensor,  # (A,) of images behind one another
    first_pixel: Tensor,  # broadcastable to (...): of the image of each point
    row_step: Tensor | int,  # pixels from one row to the next
    u: Tensor,  # (...)
    v: Tensor,  # (...)
    last_column: Tensor | int,  # broadcastable to (...): of the image of each point
    last_row: Tensor | int,
) -> BilinearPatch:
    """`bilinear_with_gradient` with the coordinates apart, the images in a row, and nothing checked."""
    u, inside_u, column, right = _cell(u, last_column)
    v, inside_v, row, below = _cell(v, last_row)
    upper = first_pixel + row * row_step + column
    lower = upper + below * row_step
    upper_left, upper_right = take(pixels, upper), take(pixels, upper + right)
    down_left, down_right = take(pixels, lower) - upper_left, take(pixels, lower + right) - upper_right
    on_left = torch.addcmul(upper_left, v, down_left)
    d_u = torch.addcmul(upper_right, v, down_right) - on_left
    value = torch.addcmul(on_left, u, d_u)
    d_v = torch.addcmul(down_left, u, down_right - down_left)
    return BilinearPatch(value, d_u * inside_u, d_v * inside_v, inside_u & inside_v)


def _cell(
    coordinate: Tensor,  # (...)
    last: Tensor | int,  # broadcastable to (...)
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Fraction within the cell, whether inside, first index of the cell, step to its second (0 where there is none)."""
    # A number from the host would be waited for.
    last = last.int() if isinstance(last, Tensor) else coordinate.new_full((), last, dtype=torch.int32)
    # Not a choice by `inside`, which takes four times as long; not `minimum`, which halves derivatives on the last row;
    # NaN must not become an index.
    clamped = coordinate.nan_to_num(0.0).clamp_min(0).clamp_max(last)
    index = clamped.detach().int().minimum((last - 1).clamp_min(0))
    return clamped - index, clamped == coordinate, index, last.clamp(max=1)


def _check(images: Tensor, frame_index: Tensor, uv: Tensor) -> None:
    if images.ndim != 3:
        raise InputError("images", "shape (F, H, W)", f"{tuple(images.shape)}", "call grey_levels first")
    if uv.ndim < 1 or uv.shape[-1] != 2:
        raise InputError("uv", "shape (..., 2)", f"{tuple(uv.shape)}", "stack (column, row) last")
    try:
        frame_index.expand(uv.shape[:-1])
    except RuntimeError as error:
        raise InputError(
            "frame_index",
            f"a shape that broadcasts to {tuple(uv.shape[:-1])}",
            f"{tuple(frame_index.shape)}",
            "for neighbourhoods (P, N, 2) give frame_index as (P, 1)",
        ) from error
