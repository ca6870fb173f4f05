"""Regions: the part of each image that can speak about a car, as half-open boxes, and all pixels of them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from directshape_torch.errors import InputError

MASK_THRESHOLD = 0.5
"""Foreground probability above which an instance covers a pixel."""


def region_boxes(
    boxes: Tensor,  # (B, 4)
    mask_boxes: Tensor,  # (B, 4)
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
        mask_boxes: (B, 4) integer, half open, as `mask_extents` finds them; all 0 where there is no mask.
        sizes: (B, 2) integer (height, width) of each object's frame without padding.
        join: whether the box counts beside a mask.

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


@dataclass(frozen=True)
class RegionPixels:
    """All A pixels of B regions, object by object, row-major: R runs, the rows of the regions.

    Attributes:
        run_object, run_v, run_u: (R,) object of each run, its row and its first column.
        run_start: (R,) number of its first pixel.
        run: (A,) int32, for speed: the run of each pixel.
    """

    run_object: Tensor
    run_v: Tensor
    run_u: Tensor
    run_start: Tensor
    run: Tensor

    def __len__(self) -> int:
        return len(self.run)

    def of_runs(self, values: Tensor) -> Tensor:
        """Values (R,) of the runs as values (A,) of their pixels."""
        return values.index_select(0, self.run)

    def rising(self, first: Tensor) -> Tensor:
        """Integers (A,) that begin with `first` (R,) in each run and rise by one a pixel."""
        number = torch.arange(len(self), dtype=torch.int32, device=first.device)
        return self.of_runs(first - self.run_start.to(first.dtype)).add_(number)

    @property
    def object_index(self) -> Tensor:
        """(A,)"""
        return self.of_runs(self.run_object)

    @property
    def u(self) -> Tensor:
        """(A,)"""
        return self.rising(self.run_u)

    @property
    def v(self) -> Tensor:
        """(A,)"""
        return self.of_runs(self.run_v)

    def uv_of(self, pixel: Tensor) -> tuple[Tensor, Tensor]:
        """Object (P,) and uv (P, 2) of some of the pixels, by their numbers (P,)."""
        run = self.run.index_select(0, pixel)
        u = (self.run_u - self.run_start).index_select(0, run) + pixel
        return self.run_object.index_select(0, run), torch.stack([u, self.run_v.index_select(0, run)], dim=-1)

    def number_at(self, regions: Tensor, object_index: Tensor, u: Tensor, v: Tensor) -> Tensor:
        """Numbers (P,) of pixels, by region and position, the inverse of `uv_of`; any number outside of the region."""
        heights = regions[:, 3] - regions[:, 1]
        row = (heights.cumsum(0) - heights - regions[:, 1]).index_select(0, object_index) + v
        first = self.run_start - self.run_u
        return first.index_select(0, row.clamp(0, max(len(first) - 1, 0))) + u

    @classmethod
    def of(
        cls,
        regions: Tensor,  # (B, 4)
    ) -> RegionPixels:
        """The pixels of half-open integer regions (u0, v0, u1, v1), with one host synchronisation."""
        u0, v0, u1, v1 = regions.unbind(dim=1)
        widths, heights = u1 - u0, v1 - v0
        num_runs, num_pixels = torch.stack([heights.sum(), (widths * heights).sum()]).tolist()
        number = torch.arange(len(regions), device=regions.device)
        run_object = number.repeat_interleave(heights, output_size=num_runs)
        run_number = torch.arange(num_runs, device=regions.device)
        row = run_number - (heights.cumsum(0) - heights)[run_object]
        length = widths[run_object]
        run = run_number.int().repeat_interleave(length, output_size=num_pixels)
        return cls(run_object, row + v0[run_object], u0[run_object], length.cumsum(0) - length, run)


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
    pixels = RegionPixels.of(regions)
    return pixels.object_index, torch.stack([pixels.u, pixels.v], dim=-1)
