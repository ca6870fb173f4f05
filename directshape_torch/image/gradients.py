"""Grey levels and central-difference gradients of padded image stacks."""

from __future__ import annotations

import torch
from torch import Tensor

from directshape_torch.errors import InputError

LUMA_WEIGHTS = (0.299, 0.587, 0.114)
"""Weights of red, green and blue in a grey level (ITU-R BT.601)."""


def grey_levels(
    images: Tensor,  # (F, 3, H, W)
) -> Tensor:
    """Grey levels 0..255 of RGB images in [0, 1].

    Args:
        images: (F, 3, H, W), RGB in [0, 1].

    Returns:
        (F, H, W), `255 (0.299 R + 0.587 G + 0.114 B)`.

    Raises:
        InputError: not (F, 3, H, W) or not floating point.

    Example:
        >>> grey_levels(torch.ones(1, 3, 1, 2, dtype=torch.float64))
        tensor([[[255., 255.]]], dtype=torch.float64)
    """
    if images.ndim != 4 or images.shape[1] != 3:
        raise InputError("images", "shape (F, 3, H, W)", f"{tuple(images.shape)}", "put the colour axis second")
    if not images.is_floating_point():
        raise InputError("images", "floating point in [0, 1]", str(images.dtype), "divide by 255")
    return grey_of_channels(images[:, 0], images[:, 1], images[:, 2])


def grey_of_channels(
    red: Tensor,  # (*,)
    green: Tensor,  # (*,)
    blue: Tensor,  # (*,)
) -> Tensor:
    """`grey_levels` of pixels whose channels lie in tensors of their own, in [0, 1].

    Example:
        >>> grey_of_channels(*torch.eye(3, dtype=torch.float64))
        tensor([ 76.2450, 149.6850,  29.0700], dtype=torch.float64)
    """
    of_red, of_green, of_blue = (255.0 * weight for weight in LUMA_WEIGHTS)
    # In the memory of the first product: whole frames are larger than any cache.
    return (red * of_red).add_(green, alpha=of_green).add_(blue, alpha=of_blue)


def image_gradient(
    grey: Tensor,  # (F, H, W)
    sizes: Tensor | None = None,  # (F, 2)
) -> Tensor:
    """Central differences with a replicated border.

    Args:
        grey: (F, H, W), any unit.
        sizes: (F, 2) integer (height, width) of each frame without its padding; None: no padding. The border is
            replicated at each frame's own edge, so padding changes no value inside; values in the padding mean nothing.

    Returns:
        (F, 2, H, W): d/du and d/dv, in the unit of `grey` per pixel.

    Raises:
        InputError: `grey` is not (F, H, W).

    Example:
        >>> ramp = torch.arange(4.0).repeat(1, 3, 1)
        >>> image_gradient(ramp)[0, 0, 0]
        tensor([0.5000, 1.0000, 1.0000, 0.5000])
    """
    if grey.ndim != 3:
        raise InputError("grey", "shape (F, H, W)", f"{tuple(grey.shape)}", "call grey_levels first")
    heights, widths = (None, None) if sizes is None else (sizes[:, 0], sizes[:, 1])
    return torch.stack([_central_difference(grey, 2, widths), _central_difference(grey, 1, heights)], dim=1)


def gradient_magnitude(
    gradient: Tensor,  # (F, 2, H, W)
) -> Tensor:
    """Euclidean length of an image gradient, (F, H, W); its derivative is 0 where the image is flat.

    Example:
        >>> gradient_magnitude(torch.tensor([3.0, 4.0]).reshape(1, 2, 1, 1))
        tensor([[[5.]]])
    """
    return length_2d(gradient[:, 0], gradient[:, 1])


def length_2d(
    d_u: Tensor,  # (*,)
    d_v: Tensor,  # (*,)
) -> Tensor:
    """`gradient_magnitude` of components that lie in tensors of their own.

    A length that is not finite has no derivative either: 0 and not NaN, which a product with the 0 of whoever does not
    use it would spread over the image.

    Example:
        >>> flat = torch.zeros(1, requires_grad=True)
        >>> length_2d(flat, flat).backward()
        >>> flat.grad
        tensor([0.])
    """
    square = (d_u * d_u).add_(d_v * d_v)
    if not square.requires_grad:
        return square.sqrt_()
    constant = square.detach().sqrt()
    has_slope = (constant > 0) & constant.isfinite()
    d_u, d_v = (torch.where(has_slope, d, 0) for d in (d_u, d_v))
    square = torch.where(has_slope, d_u * d_u + d_v * d_v, 1)
    return torch.where(has_slope, square.sqrt(), constant)


def _central_difference(
    grey: Tensor,  # (F, H, W)
    axis: int,
    lengths: Tensor | None,  # (F,)
) -> Tensor:
    length = grey.shape[axis]
    following = torch.cat([grey.narrow(axis, 1, length - 1), grey.narrow(axis, length - 1, 1)], dim=axis)
    preceding = torch.cat([grey.narrow(axis, 0, 1), grey.narrow(axis, 0, length - 1)], dim=axis)
    if lengths is not None:
        position = torch.arange(length, device=grey.device)
        beyond = position >= lengths.to(grey.device)[:, None] - 1
        following = torch.where(beyond.unsqueeze(3 - axis), grey, following)
    return (following - preceding) / 2
