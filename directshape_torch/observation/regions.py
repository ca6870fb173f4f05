"""Regions: the part of each image that can speak about a car, as half-open boxes; their pixels and small cells."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.config import SamplingConfig
from directshape_torch.errors import InputError

MASK_THRESHOLD = 0.5
"""Foreground probability above which an instance covers a pixel."""

_MARGIN_PX, _MARGIN_SHARE = 4.0, 0.1


def region_boxes(
    boxes: Tensor,  # (B, 4)
    mask_boxes: Tensor,  # (B, 4)
    sizes: Tensor,  # (B, 2)
) -> Tensor:
    """The region whose pixels can speak about each car, on one side.

    The mask's box joined with the given one, grown on every side by the larger of 4 px and a tenth of its width (or
    height) and clipped to the image, so that a shape that spills out of its mask pays for it. An empty mask counts as
    none.

    Args:
        boxes: (B, 4) u_min, v_min, u_max, v_max, pixels. NaN, or outside of the image: no box.
        mask_boxes: (B, 4) integer, half open, as `mask_extents` finds them; all 0 where there is no mask.
        sizes: (B, 2) integer (height, width) of each object's frame without padding.

    Returns:
        (B, 4) integer (u0, v0, u1, v1), half open: `image[v0:v1, u0:u1]`; all 0 where nothing is left.

    Raises:
        InputError: wrong shapes.
    """
    count = len(boxes)
    expected = (("boxes", boxes, (count, 4)), ("mask_boxes", mask_boxes, (count, 4)), ("sizes", sizes, (count, 2)))
    for name, tensor, shape in expected:
        if tensor.shape != shape:
            raise InputError(name, f"shape {shape}", f"{tuple(tensor.shape)}")
    last_uv = (sizes.flip(-1) - 1).to(boxes.dtype)
    in_mask = mask_boxes[:, 2] > mask_boxes[:, 0]
    mask_box = torch.cat([mask_boxes[:, :2], mask_boxes[:, 2:] - 1], dim=1).to(boxes.dtype)
    in_image = (boxes[:, 2:] >= 0).all(dim=1) & (boxes[:, :2] <= last_uv).all(dim=1)
    box_counts = in_image & (boxes[:, 2:] >= boxes[:, :2]).all(dim=1)

    far = torch.full_like(last_uv, torch.inf)
    low, high = far, -far
    for box, counts in ((mask_box, in_mask), (boxes, box_counts)):
        low = torch.minimum(low, torch.where(counts[:, None], box[:, :2], far))
        high = torch.maximum(high, torch.where(counts[:, None], box[:, 2:], -far))
    low, high = low.clamp(min=0).minimum(last_uv), high.clamp(min=0).minimum(last_uv)
    margin = (_MARGIN_SHARE * (high - low)).clamp(min=_MARGIN_PX)
    first = (low - margin).floor().clamp(min=0)
    end = (high + margin).ceil().minimum(last_uv) + 1
    return torch.cat([first, end], dim=1).long() * (in_mask | box_counts)[:, None]


def region_pixels(
    regions: Tensor,  # (B, 4)
) -> tuple[Tensor, Tensor]:
    """All pixels of half-open regions, packed object by object, row-major.

    Args:
        regions: (B, 4) integer (u0, v0, u1, v1).

    Returns:
        object_index (A,) and uv (A, 2), integer.

    Examples:
        >>> object_index, uv = region_pixels(torch.tensor([[5, 2, 7, 3], [0, 0, 1, 2]]))
        >>> object_index.tolist(), uv.tolist()
        ([0, 0, 1, 1], [[5, 2], [6, 2], [0, 0], [0, 1]])
    """
    u0, v0, u1, v1 = regions.unbind(dim=1)
    widths, areas = u1 - u0, (u1 - u0) * (v1 - v0)
    of = torch.arange(len(regions), device=regions.device).repeat_interleave(areas)
    place = torch.arange(len(of), device=regions.device) - (areas.cumsum(0) - areas)[of]
    row = torch.div(place, widths[of], rounding_mode="floor")
    return of, torch.stack([u0[of] + place - row * widths[of], v0[of] + row], dim=-1)


class CellPixels(NamedTuple):
    """One for each small cell of all regions, in order; numbers mean nothing where there is none."""

    object_index: Tensor  # (N,)
    u: Tensor  # (N,)
    v: Tensor  # (N,)
    exists: Tensor  # (N,) bool


def small_cell_side(
    regions: Tensor,  # (B, 4)
    settings: SamplingConfig,
) -> Tensor:
    """Side of the cells of each region, (B,) float64, pixels: `sqrt(h w / n)` with `n = clip(density h w, min, max)`.

    They are laid from the region's upper left corner and are never below one pixel, so a tiny region gives every pixel
    it has. (The paper counts the detection's box; the region is used so that the density in it is the wanted one.)
    """
    areas = ((regions[:, 3] - regions[:, 1]) * (regions[:, 2] - regions[:, 0])).double()
    wanted = (settings.density * areas).clamp(settings.min_pixels, settings.max_pixels)
    return (areas / wanted).sqrt().clamp(min=1.0)
