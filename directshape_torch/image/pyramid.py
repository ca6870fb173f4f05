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

    An odd last row or column has no partner and is dropped, so that every coarse pixel is a true 2x2 mean, with its
    centre at pixel `2 u + 0.5` of the finer level.

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
