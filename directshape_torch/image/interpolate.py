"""This module looks values up bilinearly in images, with the exact derivative of the lookup."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.numerics.tensors import take


class BilinearPatch(NamedTuple):
    """A `BilinearPatch` is a lookup with its derivatives by the two coordinates."""

    value: Tensor  # (...)
    d_u: Tensor  # (...) per pixel
    d_v: Tensor  # (...) per pixel
    inside: Tensor  # (...) bool: within the image, including centres of border pixels; false for NaN


def bilinear_at(
    image: Tensor,  # (H, W)
    uv: Tensor,  # (..., 2) pixels (column, row)
) -> BilinearPatch:
    """The lookup of `bilinear_patch` in one image."""
    height, width = image.shape
    first = torch.zeros((), dtype=torch.long, device=image.device)
    return bilinear_patch(image.reshape(-1), first, width, uv[..., 0], uv[..., 1], width - 1, height - 1)


def bilinear_patch(
    pixels: Tensor,  # (A,) of images behind one another
    first_pixel: Tensor,  # broadcastable to (...): index of the first pixel of each point's image
    row_step: Tensor | int,  # pixels from one row to the next
    u: Tensor,  # (...)
    v: Tensor,  # (...)
    last_column: Tensor | int,  # broadcastable to (...): last column of each point's image
    last_row: Tensor | int,  # broadcastable to (...): last row of each point's image
) -> BilinearPatch:
    """Value at (u, v), (0, 0) being the centre of the top-left pixel, and the exact derivative of the bilinear patch.

    The gradient belongs to the cell right and below of a point that lies on a grid line (left and above on the last
    row and column). A coordinate outside the image is clamped to it, where the lookup is constant in that coordinate:
    its derivative is 0. Autograd differentiates the value by pixels and coordinates, and agrees with the returned
    gradient.
    """
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
    """Fraction within the cell, whether inside, first index of the cell, step to its second index (0 without one)."""
    # A copy of a number from the host would make the device wait.
    last = last.int() if isinstance(last, Tensor) else coordinate.new_full((), last, dtype=torch.int32)
    # A choice by `inside` would take four times as long, `minimum` would halve derivatives on the last row, and NaN
    # must not become an index.
    clamped = coordinate.nan_to_num(0.0).clamp_min(0).clamp_max(last)
    index = clamped.detach().int().minimum((last - 1).clamp_min(0))
    return clamped - index, clamped == coordinate, index, last.clamp(max=1)
