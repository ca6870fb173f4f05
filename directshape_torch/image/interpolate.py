"""Bilinear lookup in a stack of images, with the exact derivative of that lookup."""

from __future__ import annotations

import torch
from torch import Tensor

from directshape_torch.errors import InputError


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

    Example:
        >>> image = torch.tensor([[[0.0, 2.0], [10.0, 12.0]]])
        >>> value, gradient, inside = bilinear_with_gradient(image, torch.tensor([0]), torch.tensor([[0.5, 0.25]]))
        >>> value, gradient, inside
        (tensor([3.5000]), tensor([[ 2., 10.]]), tensor([True]))
    """
    _check(images, frame_index, uv)
    height, width = images.shape[1:]
    u, inside_u, column, right = _cell(uv[..., 0], width, None if sizes is None else sizes[:, 1][frame_index])
    v, inside_v, row, below = _cell(uv[..., 1], height, None if sizes is None else sizes[:, 0][frame_index])

    corner = (frame_index * height + row) * width + column
    flat = images.reshape(-1)
    step_down = below * width
    upper_left, upper_right = _take(flat, corner), _take(flat, corner + right)
    corner = corner + step_down
    lower_left, lower_right = _take(flat, corner), _take(flat, corner + right)

    upper_slope = upper_right - upper_left
    lower_slope = lower_right - lower_left
    upper = upper_left + u * upper_slope
    lower = lower_left + u * lower_slope
    d_v = lower - upper
    value = upper + v * d_v
    d_u = upper_slope + v * (lower_slope - upper_slope)
    gradient = torch.stack([d_u * inside_u, d_v * inside_v], dim=-1)
    return value, gradient, inside_u & inside_v


def _cell(
    coordinate: Tensor,  # (...)
    full_length: int,
    length: Tensor | None,  # (...)
) -> tuple[Tensor, Tensor, Tensor, Tensor | int]:
    """Fraction within the cell, whether inside, first index of the cell, step to its second (0 where there is none)."""
    last: Tensor | int = full_length - 1 if length is None else length - 1
    inside = (coordinate >= 0) & (coordinate <= last)
    # `where` and not `clamp`: its derivative outside is 0 by the same rule as `inside`, and NaN cannot pass.
    clamped = torch.where(inside, coordinate, (coordinate > 0) * last)
    if isinstance(last, int):
        index = clamped.detach().long().clamp_(max=max(last - 1, 0))
        return clamped - index, inside, index, min(last, 1)
    index = torch.minimum(clamped.detach().long(), (last - 1).clamp(min=0))
    return clamped - index, inside, index, last.clamp(max=1)


def _take(
    flat: Tensor,  # (F * H * W,)
    index: Tensor,  # (...)
) -> Tensor:
    return flat.index_select(0, index.reshape(-1)).reshape(index.shape)


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
