"""Grey levels and gradients of square tiles of images: work where something is to be seen, not in whole frames."""

from __future__ import annotations

import torch
from torch import Tensor

from directshape_torch.image.gradients import grey_of_channels, length_2d


def grey_tiles(
    images: Tensor,  # (F, 3, H, W)
    sizes: Tensor,  # (F, 2)
    frame: Tensor,  # (C,)
    row: Tensor,  # (C,)
    column: Tensor,  # (C,)
    side_px: int,
    margin_px: int = 1,
) -> Tensor:
    """Grey levels of tiles with a margin; beyond a frame's own edge the edge is replicated.

    Args:
        images: (F, 3, H, W), RGB in [0, 1], padded at the right and bottom.
        sizes: (F, 2) integer (height, width) of each frame without padding.
        frame, row, column: (C,) integer; tile (0, 0) begins at pixel (0, 0).
        side_px: of the tiles.
        margin_px: further pixels on each of the four sides.

    Returns:
        (C, side + 2 margin, side + 2 margin), the same numbers as those of `grey_levels`.

    Example:
        >>> image = torch.ones(1, 3, 40, 40)
        >>> zero = torch.tensor([0])
        >>> grey_tiles(image, torch.tensor([[40, 40]]), zero, zero, zero + 1, side_px=32).shape
        torch.Size([1, 34, 34])
    """
    height, width = images.shape[2:]
    step = torch.arange(-margin_px, side_px + margin_px, device=images.device)
    last = sizes[frame] - 1
    v = (row[:, None] * side_px + step).clamp_min(0).minimum(last[:, :1])
    u = (column[:, None] * side_px + step).clamp_min(0).minimum(last[:, 1:])
    # Half as wide indices are twice as fast, where they reach.
    index_dtype = torch.int32 if images.numel() < 2**31 else torch.int64
    line = ((frame[:, None] * (3 * height) + v) * width).to(index_dtype)
    pixel = line[:, :, None] + u.to(index_dtype)[:, None, :]
    flat, index, image_size = images.reshape(-1), pixel.flatten(), height * width
    red = flat.index_select(0, index)
    green, blue = (flat[c * image_size :].index_select(0, index) for c in (1, 2))
    return grey_of_channels(red, green, blue).view(pixel.shape)


def tile_gradient_magnitude(
    grey: Tensor,  # (C, n + 2, n + 2)
) -> Tensor:
    """Length of the central differences, (C, n, n), of tiles with a margin of one pixel.

    Example:
        >>> tile_gradient_magnitude(torch.arange(4.0).repeat(1, 4, 1))
        tensor([[[1., 1.],
                 [1., 1.]]])
    """
    d_u = (grey[:, 1:-1, 2:] - grey[:, 1:-1, :-2]) / 2
    d_v = (grey[:, 2:, 1:-1] - grey[:, :-2, 1:-1]) / 2
    return length_2d(d_u, d_v)
