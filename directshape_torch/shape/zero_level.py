"""Extents of the zero level of signed distance grids, finer than the grid."""

from __future__ import annotations

import torch
from torch import Tensor

from directshape_torch.errors import InputError


def zero_level_extents(
    values: Tensor,  # (B, nx, ny, nz)
    origin: Tensor,  # (3,)
    spacing_m: float,
) -> Tensor:  # (B, 2, 3)
    """Lower and upper corner of the box around the zero level, along the object axes.

    The field is trilinear between nodes, so along an axis the outermost point of its zero level lies on a grid edge
    parallel to that axis (up to cells that the level only touches in their middle): the extent is the outermost linear
    crossing of all edges of the axis. Differentiable by `values`: the gradient flows through the outermost edge.

    Args:
        values: signed distance at the nodes, negative inside, metres.
        origin: position of node (0, 0, 0), metres.
        spacing_m: distance between nodes, metres.

    Returns:
        (B, 2, 3) lower and upper corner, metres; NaN for an object that has no zero crossing along an axis.

    Raises:
        InputError: `values` is not (B, nx, ny, nz).

    Example:
        >>> x = torch.arange(-3.0, 4.0)
        >>> sphere = torch.stack(torch.meshgrid(x, x, x, indexing="ij"), -1).norm(dim=-1) - 2.5
        >>> zero_level_extents(sphere[None], torch.full((3,), -3.0), 1.0)[0, 1]
        tensor([2.5000, 2.5000, 2.5000])
    """
    if values.ndim != 4:
        raise InputError("values", "shape (B, nx, ny, nz)", str(tuple(values.shape)))
    lower_upper = [_extent_along(values, axis) for axis in (1, 2, 3)]
    return origin + spacing_m * torch.stack([torch.stack(pair, dim=-1) for pair in lower_upper], dim=-1)


def _extent_along(values: Tensor, axis: int) -> tuple[Tensor, Tensor]:
    """First and last crossing (B,), (B,) over all edges of one axis, in nodes; NaN where there is none."""
    count = values.shape[axis]
    before, after = values.narrow(axis, 0, count - 1), values.narrow(axis, 1, count - 1)
    crosses = (before < 0) != (after < 0)
    drop = torch.where(crosses, before - after, torch.ones_like(before))
    shape = [1, 1, 1, 1]
    shape[axis] = count - 1
    node = torch.arange(count - 1, dtype=values.dtype, device=values.device).reshape(shape)
    position = node + before / drop
    nothing = torch.full_like(position, float("inf"))
    first = torch.where(crosses, position, nothing).flatten(1).amin(dim=1)
    last = torch.where(crosses, position, -nothing).flatten(1).amax(dim=1)
    found = crosses.flatten(1).any(dim=1)
    nan = torch.full_like(first, float("nan"))
    return torch.where(found, first, nan), torch.where(found, last, nan)
