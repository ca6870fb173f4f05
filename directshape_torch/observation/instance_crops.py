"""Which instances cover each pixel: one crop a frame around all its instances, one bit an instance.

So that questions about any subset of the instances cost one lookup, however many they are: `crop & bits of the subset`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate

import torch
from torch import Tensor

from directshape_torch.observation.regions import MASK_THRESHOLD, RegionPixels

_BITS_OF_A_WORD = 62
"""Instances that share an int64; the sign and one more stay out of it."""


@dataclass(frozen=True)
class InstanceCrops:
    """N instances in F frames: memory follows the area around them.

    Attributes:
        boxes: (F, 4) integer (u0, v0, u1, v1), half open, around the instances of each frame; all 0 where none is.
        start: (F,) first row of each frame in `covering`.
        covering: (A, W) int64, the instances that cover each pixel, row-major; never empty.
        bits: (N, W) int64, the bit of each instance, in one of the W words.
    """

    boxes: Tensor
    start: Tensor
    covering: Tensor
    bits: Tensor


def instance_crops(
    masks: Sequence[Tensor],
    boxes: Tensor,  # (N, 4)
    frame_index: Tensor,  # (N,)
    num_frames: int,
) -> InstanceCrops:
    """Write the instances of all frames into one crop a frame.

    Args:
        masks: stacks (I, H, W), N instances in all; foreground probability or bool.
        boxes: (N, 4) integer, half open, around the pixels of each mask above 0.5; all 0: leave the instance out.
        frame_index: (N,) integer.
        num_frames: F.

    Example:
        >>> masks = torch.zeros(2, 4, 6)
        >>> masks[0, 1, 1:4], masks[1, 1:3, 3:5] = 1.0, 1.0
        >>> boxes = torch.tensor([[1, 1, 4, 2], [3, 1, 5, 3]])
        >>> crops = instance_crops([masks], boxes, torch.tensor([0, 0]), num_frames=1)
        >>> crops.covering.view(2, 4)
        tensor([[1, 1, 3, 2],
                [0, 0, 2, 2]])
    """
    there = boxes[:, 2] > boxes[:, 0]
    rank = _rank_in_frame(there, frame_index, num_frames)
    crops = _boxes_around(boxes, there, frame_index, num_frames)
    widths = crops[:, 2] - crops[:, 0]
    areas = widths * (crops[:, 3] - crops[:, 1])
    start = areas.cumsum(0) - areas
    box_areas = (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])
    pixels_up_to = [box_areas[:end].sum() for end in accumulate(len(stack) for stack in masks)]
    most, num_pixels, *ends = torch.stack([_largest(rank), areas.sum(), *pixels_up_to]).tolist()
    num_words = most // _BITS_OF_A_WORD + 1
    word, bit = torch.div(rank, _BITS_OF_A_WORD, rounding_mode="floor"), there.long() << (rank % _BITS_OF_A_WORD)
    bits = torch.where(word[:, None] == torch.arange(num_words, device=boxes.device), bit[:, None], 0)

    pixels = RegionPixels.of(boxes)
    corner = start - crops[:, 1] * widths - crops[:, 0]
    run_frame = frame_index.index_select(0, pixels.run_object)
    run_start = corner.index_select(0, run_frame) + pixels.run_v * widths.index_select(0, run_frame)
    entry = pixels.rising(run_start + pixels.run_u)
    if num_words > 1:
        entry = entry * num_words + pixels.of_runs(word.index_select(0, pixels.run_object))
    # Every instance has a bit of its own, so adding is setting it.
    value = pixels.of_runs(bit.index_select(0, pixels.run_object)) * _covers(masks, pixels, ends)
    covering = torch.zeros(max(num_pixels, 1) * num_words, dtype=torch.long, device=boxes.device)
    return InstanceCrops(crops, start, covering.index_add_(0, entry, value).view(-1, num_words), bits)


def _largest(values: Tensor) -> Tensor:
    return values.amax() if len(values) else values.new_zeros(())


def _rank_in_frame(there: Tensor, frame_index: Tensor, num_frames: int) -> Tensor:
    """Number (N,) of each instance that is there among those of its frame; 0 for the others."""
    by_frame = torch.argsort(frame_index, stable=True)
    counts = torch.zeros(num_frames, dtype=torch.long, device=there.device).index_add_(0, frame_index, there.long())
    before_frame = (counts.cumsum(0) - counts)[frame_index]
    before = torch.empty_like(frame_index)
    before[by_frame] = there[by_frame].long().cumsum(0) - 1
    return (before - before_frame) * there


def _boxes_around(boxes: Tensor, there: Tensor, frame_index: Tensor, num_frames: int) -> Tensor:
    """Box (F, 4) around the boxes (N, 4) of each frame; all 0 where none is there."""
    number = frame_index[:, None].expand(-1, 2)
    far = torch.iinfo(torch.long).max
    low = boxes.new_full((num_frames, 2), far)
    low.scatter_reduce_(0, number, torch.where(there[:, None], boxes[:, :2], far), "amin")
    high = boxes.new_zeros(num_frames, 2).scatter_reduce_(0, number, boxes[:, 2:] * there[:, None], "amax")
    return torch.cat([torch.where(high > 0, low, 0), high], dim=1)


def _covers(masks: Sequence[Tensor], pixels: RegionPixels, ends: Sequence[int]) -> Tensor:
    """Whether each pixel (A,) is covered by the mask whose box it lies in; those of each stack end at `ends`."""
    height, width = masks[0].shape[1:]
    pixel = pixels.rising((pixels.run_object * height + pixels.run_v) * width + pixels.run_u)
    parts, begin, first = [], 0, 0
    for stack, end in zip(masks, ends, strict=True):
        of_stack = pixel[begin:end] - first * height * width
        parts.append(stack.detach().flatten().index_select(0, of_stack) > MASK_THRESHOLD)
        begin, first = end, first + len(stack)
    return torch.cat(parts)
