"""Gradients of parts of frames and of single pixels: work where something is to be seen, not in whole frames."""

from __future__ import annotations

import torch
from torch import Tensor

from directshape_torch.image.gradients import grey_levels, length_2d
from directshape_torch.numerics.table_lookup import take


def gradient_magnitude_of_part(
    image: Tensor,  # (3, H, W)
    size_hw: tuple[int, int],
    part: tuple[int, int, int, int],
) -> Tensor:
    """Length of the image gradient in one part of a frame, by central differences; differentiable by the image.

    Args:
        image: (3, H, W), RGB in [0, 1], padded at the right and bottom.
        size_hw: (height, width) of the frame without padding; at its own edge the edge is replicated.
        part: (u0, v0, u1, v1) within the frame, half open, not empty.

    Returns:
        (v1 - v0, u1 - u0), grey levels per pixel.

    Example:
        >>> ramp = torch.arange(40.0).expand(3, 40, 40) / 255
        >>> gradient_magnitude_of_part(ramp, (40, 40), (0, 8, 3, 9))
        tensor([[0.5000, 1.0000, 1.0000]])
    """
    (u0, v0, u1, v1), (height, width) = part, size_hw
    # One pixel more on each side, as far as there is one.
    left, top, right, bottom = int(u0 > 0), int(v0 > 0), int(u1 < width), int(v1 < height)
    grey = grey_levels(image[:, v0 - top : v1 + bottom, u0 - left : u1 + right])
    if not left or not top or not right or not bottom:
        missing = (1 - left, 1 - right, 1 - top, 1 - bottom)
        grey = torch.nn.functional.pad(grey[None], missing, mode="replicate")[0]
    d_u, d_v = grey[1:-1, 2:] - grey[1:-1, :-2], grey[2:, 1:-1] - grey[:-2, 1:-1]
    return length_2d(d_u, d_v).mul_(0.5)


def gradient_magnitude(
    images: Tensor,  # (F, 3, H, W)
    sizes: Tensor,  # (F, 2)
) -> Tensor:
    """`gradient_magnitude_of_part` of whole frames (F, H, W), 0 in their padding: for figures.

    Example:
        >>> ramp = torch.arange(4.0).expand(1, 3, 2, 4) / 255
        >>> gradient_magnitude(ramp, torch.tensor([[1, 4]]))
        tensor([[[0.5000, 1.0000, 1.0000, 0.5000],
                 [0.0000, 0.0000, 0.0000, 0.0000]]])
    """
    magnitude = torch.zeros_like(images[:, 0])
    for frame, (height, width) in enumerate(sizes.tolist()):
        whole = gradient_magnitude_of_part(images[frame], (height, width), (0, 0, width, height))
        magnitude[frame, :height, :width] = whole
    return magnitude


def gradient_magnitude_at(
    images: Tensor,  # (F, 3, H, W)
    sizes: Tensor,  # (F, 2)
    frame_index: Tensor,  # (P,)
    uv: Tensor,  # (P, 2)
) -> Tensor:
    """`gradient_magnitude_of_part` at single pixels, the same numbers; differentiable by the images.

    Args:
        images: (F, 3, H, W), RGB in [0, 1], padded at the right and bottom.
        sizes: (F, 2) integer (height, width) of each frame without padding; at its own edge the edge is replicated.
        frame_index: (P,) frame of each pixel.
        uv: (P, 2) integer, within their frames.

    Returns:
        (P,), grey levels per pixel.

    Example:
        >>> ramp = torch.arange(40.0).expand(1, 3, 40, 40) / 255
        >>> gradient_magnitude_at(ramp, torch.tensor([[40, 40]]), torch.tensor([0, 0]), torch.tensor([[0, 8], [1, 8]]))
        tensor([0.5000, 1.0000])
    """
    last_v, last_u = (sizes - 1).index_select(0, frame_index).unbind(1)
    u, v = uv.unbind(1)
    # To the right, to the left, below, above.
    places_u = torch.stack([torch.minimum(u + 1, last_u), (u - 1).clamp_min(0), u, u])
    places_v = torch.stack([v, v, torch.minimum(v + 1, last_v), (v - 1).clamp_min(0)])
    channel = torch.arange(3, device=images.device)[:, None, None]
    if images.is_contiguous():
        plane = frame_index * 3 + channel
        values = take(images.view(-1), (plane * images.shape[2] + places_v) * images.shape[3] + places_u)
    else:
        # Without a copy of whole frames that lie in memory in another order.
        values = images[frame_index, channel, places_v, places_u]
    right, left, below, above = grey_levels(values).unbind(0)
    return length_2d(right - left, below - above).mul_(0.5)
