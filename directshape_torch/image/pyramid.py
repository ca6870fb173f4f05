"""Image pyramid by exact 2x2 means, with the intrinsics that belong to each level."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from directshape_torch.errors import InputError


def halve(
    images: Tensor,  # (F, C, H, W)
) -> Tensor:
    """The next coarser pyramid level: each pixel is the mean of a 2x2 block.

    An odd last row or column has no partner and is dropped, so that every coarse pixel is a true 2x2 mean and
    `halve_intrinsics` holds exactly.

    Args:
        images: (F, C, H, W), H and W at least 2.

    Returns:
        (F, C, H // 2, W // 2).

    Raises:
        InputError: not four axes, or a side below 2 pixels.

    Example:
        >>> halve(torch.arange(8.0).reshape(1, 1, 2, 4))
        tensor([[[[2.5000, 4.5000]]]])
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
    """(height, width) of each frame one level up; integer division, as `halve` drops an odd last row or column.

    A side of one pixel stays one: a lookup must find a pixel in every frame of a batch.

    Example:
        >>> halve_sizes(torch.tensor([[375, 1242]]))
        tensor([[187, 621]])
    """
    return torch.div(sizes, 2, rounding_mode="floor").clamp_min(1)


def halve_intrinsics(
    K: Tensor,  # (..., 3, 3)
) -> Tensor:
    """Intrinsics of the next coarser level: focal lengths and skew halved, centre `(c + 0.5) / 2 - 0.5`.

    Args:
        K: (..., 3, 3), pixels, pixel centres at integers.

    Raises:
        InputError: not (..., 3, 3).

    Example:
        >>> halve_intrinsics(torch.tensor([[700.0, 0.0, 600.0], [0.0, 700.0, 180.0], [0.0, 0.0, 1.0]]))
        tensor([[350.0000,   0.0000, 299.7500],
                [  0.0000, 350.0000,  89.7500],
                [  0.0000,   0.0000,   1.0000]])
    """
    if K.shape[-2:] != (3, 3):
        raise InputError("K", "shape (..., 3, 3)", f"{tuple(K.shape)}")
    level_from_full = K.new_tensor([[0.5, 0.0, -0.25], [0.0, 0.5, -0.25], [0.0, 0.0, 1.0]])
    return level_from_full @ K


@dataclass(frozen=True)
class GreyPair:
    """Grey levels of both images at one pyramid level."""

    left: Tensor  # (F, H, W)
    right: Tensor  # (F, H, W)
    sizes: Tensor  # (F, 2)
    scale: float  # level pixels per full-resolution pixel

    def halved(self) -> GreyPair:
        """The next coarser level."""
        left, right = (halve(image[:, None])[:, 0] for image in (self.left, self.right))
        return GreyPair(left, right, halve_sizes(self.sizes), 0.5 * self.scale)
