"""Regions: the part of each image that can speak about a car, as half-open boxes, and all pixels of them."""

from __future__ import annotations

import torch
from torch import Tensor

from directshape_torch.errors import InputError

MASK_THRESHOLD = 0.5
"""Foreground probability above which an instance covers a pixel."""


def region_boxes(
    boxes: Tensor,  # (B, 4)
    masks: Tensor,  # (B, H, W)
    has_mask: Tensor,  # (B,)
    sizes: Tensor,  # (B, 2)
    *,
    join: bool,
    margin_px: float = 4.0,
    margin_share: float = 0.1,
) -> Tensor:
    """The region whose pixels can speak about each car, on one side.

    Left image: give the detection's 2D boxes and `join=True`: the mask's box joined with it. Right image: give the
    initial 3D boxes projected into it and `join=False`: the mask's box, or the projected one where there is no mask.
    Each is grown by the larger of `margin_px` and `margin_share` of its width (or height) on every side and clipped to
    the image, so that a shape that spills out of its mask pays for it. An empty mask counts as none.

    Args:
        boxes: (B, 4) u_min, v_min, u_max, v_max, pixels. NaN, or outside of the image: no box.
        masks: (B, H, W) foreground probability or bool.
        has_mask: (B,) bool.
        sizes: (B, 2) integer (height, width) of each object's frame without padding.
        join: whether the box counts beside a mask.

    Returns:
        (B, 4) integer (u0, v0, u1, v1), half open: `image[v0:v1, u0:u1]`; all 0 where nothing is left.

    Raises:
        InputError: wrong shapes.
    """
    _check_boxes(boxes, masks, has_mask, sizes)
    last_uv = (sizes.flip(-1) - 1).to(boxes.dtype)
    mask_box, in_mask = _mask_boxes(masks, has_mask, boxes.dtype)
    in_image = (boxes[:, 2:] >= 0).all(dim=1) & (boxes[:, :2] <= last_uv).all(dim=1)
    box_counts = in_image & (boxes[:, 2:] >= boxes[:, :2]).all(dim=1) & (~in_mask | join)

    far = torch.full_like(last_uv, torch.inf)
    low, high = far, -far
    for box, counts in ((mask_box, in_mask), (boxes, box_counts)):
        low = torch.minimum(low, torch.where(counts[:, None], box[:, :2], far))
        high = torch.maximum(high, torch.where(counts[:, None], box[:, 2:], -far))
    low, high = low.clamp(min=0).minimum(last_uv), high.clamp(min=0).minimum(last_uv)
    margin = (margin_share * (high - low)).clamp(min=margin_px)
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

    Example:
        >>> object_index, uv = region_pixels(torch.tensor([[5, 2, 7, 3], [0, 0, 1, 2]]))
        >>> object_index.tolist(), uv.tolist()
        ([0, 0, 1, 1], [[5, 2], [6, 2], [0, 0], [0, 1]])
    """
    widths, heights = regions[:, 2] - regions[:, 0], regions[:, 3] - regions[:, 1]
    # Row by row: one division-free expansion a level.
    row_object = torch.arange(len(regions), device=regions.device).repeat_interleave(heights)
    row_v = _position_in_run(heights) + regions[row_object, 1]
    row_width = widths[row_object]
    row = torch.arange(len(row_v), device=regions.device).repeat_interleave(row_width)
    object_index = row_object[row]
    u = _position_in_run(row_width) + regions[:, 0][object_index]
    return object_index, torch.stack([u, row_v[row]], dim=-1)


def _mask_boxes(
    masks: Tensor,  # (B, H, W)
    has_mask: Tensor,  # (B,)
    dtype: torch.dtype,
) -> tuple[Tensor, Tensor]:
    """Box (B, 4) of the pixel centres of each mask, and whether there is such a pixel (B,)."""
    covered = masks > MASK_THRESHOLD
    in_rows, in_columns = covered.any(dim=2), covered.any(dim=1)
    (u0, u1), (v0, v1) = _first_and_last(in_columns), _first_and_last(in_rows)
    return torch.stack([u0, v0, u1, v1], dim=1).to(dtype), in_rows.any(dim=1) & has_mask


def _first_and_last(
    flags: Tensor,  # (B, L)
) -> tuple[Tensor, Tensor]:
    """Position of the first and last True of each row; (0, L - 1) or nonsense where there is none."""
    position = torch.arange(flags.shape[1], device=flags.device)
    first = torch.where(flags, position, flags.shape[1]).amin(dim=1)
    return first, torch.where(flags, position, -1).amax(dim=1)


def _position_in_run(
    lengths: Tensor,  # (R,)
) -> Tensor:
    """0 .. length - 1 for each run, one after the other."""
    starts = lengths.cumsum(0) - lengths
    return torch.arange(int(lengths.sum()), device=lengths.device) - starts.repeat_interleave(lengths)


def _check_boxes(boxes: Tensor, masks: Tensor, has_mask: Tensor, sizes: Tensor) -> None:
    count = len(boxes)
    expected = (("boxes", boxes, (count, 4)), ("has_mask", has_mask, (count,)), ("sizes", sizes, (count, 2)))
    for name, tensor, shape in expected:
        if tensor.shape != shape:
            raise InputError(name, f"shape {shape}", f"{tuple(tensor.shape)}")
    if masks.ndim != 3 or len(masks) != count:
        raise InputError("masks", f"shape ({count}, H, W)", f"{tuple(masks.shape)}")
