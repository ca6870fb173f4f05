"""This module computes grey levels of images, their gradients in chosen parts, and a pyramid of exact 2x2 means."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.numerics.tensors import take

# These are the weights of red, green and blue in a grey level of 0..255 (ITU-R BT.601).
_WEIGHTS = (255 * 0.299, 255 * 0.587, 255 * 0.114)


def grey_levels(
    images: Tensor,  # (*, 3, H, W)
) -> Tensor:
    """Grey levels (*, H, W) of RGB images in [0, 1]: `255 (0.299 R + 0.587 G + 0.114 B)`.

    Raises:
        InputError: not (*, 3, H, W) or not floating point.
    """
    if images.ndim < 3 or images.shape[-3] != 3:
        raise InputError("images", "shape (*, 3, H, W)", f"{tuple(images.shape)}", "put the colour axis there")
    if not images.is_floating_point():
        raise InputError("images", "floating point in [0, 1]", str(images.dtype), "divide by 255")
    # kornia's function needs new memory for each sum, which takes twice as long on whole images.
    (red, green, blue), (of_red, of_green, of_blue) = images.unbind(-3), _WEIGHTS
    return (red * of_red).add_(green, alpha=of_green).add_(blue, alpha=of_blue)


def length_2d(
    d_u: Tensor,  # (*,)
    d_v: Tensor,  # (*,)
) -> Tensor:
    """Euclidean length (*,) of an image gradient; its derivative is 0 where the image is flat.

    The derivative is also 0 where the length is not finite. A derivative of NaN, times the gradient 0 of an unused
    pixel, would spread NaN over the image.
    """
    square = (d_u * d_u).add_(d_v * d_v)
    if not square.requires_grad:
        return square.sqrt_()
    constant = square.detach().sqrt()
    has_slope = (constant > 0) & constant.isfinite()
    d_u, d_v = (torch.where(has_slope, d, 0) for d in (d_u, d_v))
    square = torch.where(has_slope, d_u * d_u + d_v * d_v, 1)
    return torch.where(has_slope, square.sqrt(), constant)


def gradient_magnitude_of_part(
    image: Tensor,  # (3, H, W)
    size_hw: Sequence[int],
    part: Sequence[int],
) -> Tensor:
    """Length of the image gradient in a part (u0, v0, u1, v1) of a frame, half open, not empty, by central differences.

    `size_hw` is the frame without padding, at whose edge the edge is replicated. The result (v1 - v0, u1 - u0) is in
    grey levels per pixel and differentiable by the image.
    """
    (u0, v0, u1, v1), (height, width) = part, size_hw
    # The part is cut with one more pixel on each side where the frame has one.
    left, top, right, bottom = int(u0 > 0), int(v0 > 0), int(u1 < width), int(v1 < height)
    grey = grey_levels(image[:, v0 - top : v1 + bottom, u0 - left : u1 + right])
    if not left or not top or not right or not bottom:
        missing = (1 - left, 1 - right, 1 - top, 1 - bottom)
        grey = torch.nn.functional.pad(grey[None], missing, mode="replicate")[0]
    d_u, d_v = grey[1:-1, 2:] - grey[1:-1, :-2], grey[2:, 1:-1] - grey[:-2, 1:-1]
    return length_2d(d_u, d_v).mul_(0.5)


def gradient_magnitude_at(
    images: Tensor,  # (F, 3, H, W)
    sizes: Tensor,  # (F, 2)
    frame_index: Tensor,  # (P,)
    uv: Tensor,  # (P, 2)
) -> Tensor:
    """The values of `gradient_magnitude_of_part` at single pixels (P,), differentiable by the images."""
    last_v, last_u = (sizes - 1).index_select(0, frame_index).unbind(1)
    u, v = uv.unbind(1)
    # The four neighbours are right, left, below and above.
    places_u = torch.stack([torch.minimum(u + 1, last_u), (u - 1).clamp_min(0), u, u])
    places_v = torch.stack([v, v, torch.minimum(v + 1, last_v), (v - 1).clamp_min(0)])
    channel = torch.arange(3, device=images.device)[:, None, None]
    if images.is_contiguous():
        plane = frame_index * 3 + channel
        values = take(images.view(-1), (plane * images.shape[2] + places_v) * images.shape[3] + places_u)
    else:
        # Indexing avoids a copy of whole frames where they lie in memory in another order.
        values = images[frame_index, channel, places_v, places_u]
    right, left, below, above = grey_levels(values).unbind(0)
    return length_2d(right - left, below - above).mul_(0.5)


def halve(
    images: Tensor,  # (F, C, H, W)
) -> Tensor:
    """The next coarser pyramid level (F, C, H // 2, W // 2): each pixel is the mean of a 2x2 block.

    An odd last row or column has no partner and is dropped, so that every coarse pixel is a true 2x2 mean, with its
    centre at pixel `2 u + 0.5` of the finer level.

    Raises:
        InputError: not four axes, or a side below 2 pixels.
    """
    if images.ndim != 4 or min(images.shape[2:]) < 2:
        raise InputError("images", "shape (F, C, H, W) with H, W >= 2", f"{tuple(images.shape)}", "use fewer levels")
    height, width = (side // 2 * 2 for side in images.shape[2:])
    top, bottom = images[:, :, 0:height:2], images[:, :, 1:height:2]
    rows = top + bottom
    return (rows[..., 0:width:2] + rows[..., 1:width:2]) / 4


def halve_sizes(
    sizes: Tensor,  # (F, 2)
) -> Tensor:
    """(height, width) of each frame one level up; a side of one pixel stays one, for a lookup must find a pixel."""
    return torch.div(sizes, 2, rounding_mode="floor").clamp_min(1)


@dataclass(frozen=True)
class GreyPair:
    """A `GreyPair` holds the grey levels of both images at one pyramid level."""

    left: Tensor  # (F, H, W)
    right: Tensor  # (F, H, W)
    sizes: Tensor  # (F, 2)
    scale: float  # level pixels per full-resolution pixel

    def halved(self) -> GreyPair:
        """The pair at the next coarser level."""
        left, right = (halve(image[:, None])[:, 0] for image in (self.left, self.right))
        return GreyPair(left, right, halve_sizes(self.sizes), 0.5 * self.scale)
