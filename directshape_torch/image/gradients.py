"""Grey levels, and the length of a gradient."""

from __future__ import annotations

import torch
from kornia.color import rgb_to_grayscale
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.numerics.device_constants import constant_like

# Of red, green and blue in a grey level of 0..255 (ITU-R BT.601).
_WEIGHTS = (255 * 0.299, 255 * 0.587, 255 * 0.114)


def grey_levels(
    images: Tensor,  # (*, 3, H, W)
) -> Tensor:
    """Grey levels 0..255 of RGB images in [0, 1].

    Args:
        images: (*, 3, H, W), RGB in [0, 1].

    Returns:
        (*, H, W), `255 (0.299 R + 0.587 G + 0.114 B)`.

    Raises:
        InputError: not (*, 3, H, W) or not floating point.

    Example:
        >>> grey_levels(torch.ones(1, 3, 1, 2, dtype=torch.float64))
        tensor([[[255., 255.]]], dtype=torch.float64)
    """
    if images.ndim < 3 or images.shape[-3] != 3:
        raise InputError("images", "shape (*, 3, H, W)", f"{tuple(images.shape)}", "put the colour axis there")
    if not images.is_floating_point():
        raise InputError("images", "floating point in [0, 1]", str(images.dtype), "divide by 255")
    return rgb_to_grayscale(images, constant_like(_WEIGHTS, images)).squeeze(-3)


def length_2d(
    d_u: Tensor,  # (*,)
    d_v: Tensor,  # (*,)
) -> Tensor:
    """Euclidean length (*,) of an image gradient; its derivative is 0 where the image is flat.

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
