"""Which instances cover each pixel: one crop a frame around all its instances, one bit an instance.

So that questions about any subset of the instances cost one lookup, however many they are: `crop & bits of the subset`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.observation.regions import MASK_THRESHOLD

_BITS_OF_A_WORD = 31
"""Instances that share an int32, whose sign stays out of it."""

# So that frames in which nothing covers anything are no special case for whoever looks something up.
_SPARE_ROWS = 2


@dataclass(frozen=True)
class InstanceCrops:
    """N instances in F frames: memory follows the area around them.

    Attributes:
        boxes: (F, 4) integer (u0, v0, u1, v1), half open, around the instances of each frame; all 0 where none is.
        start: (F,) first row of each frame in `covering`.
        covering: (A, W) int32, the instances that cover each pixel, row-major; two more rows, which nothing covers.
        bits: (N, W) int32, the bit of each instance, in one of the W words (1, 4, 8, ...).
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
        >>> crops.covering[:8].view(2, 4)
        tensor([[1, 1, 3, 2],
                [0, 0, 2, 2]], dtype=torch.int32)
    """
    places, around = _places(torch.cat([frame_index[:, None], boxes], dim=1).tolist(), num_frames)
    width = [u1 - u0 for u0, _, u1, _ in around]
    start = [0, *accumulate((v1 - v0) * (u1 - u0) for u0, v0, u1, v1 in around)]
    num_words = _num_words(max((place.rank for place in places), default=0) + 1)
    covering = torch.zeros(start[-1] + _SPARE_ROWS, num_words, dtype=torch.int32, device=boxes.device)
    bits = [[0] * num_words for _ in boxes]
    every_mask = [mask for stack in masks for mask in stack.detach().unbind()]
    for place in places:
        word, bit = divmod(place.rank, _BITS_OF_A_WORD)
        bits[place.instance][word] = 1 << bit
        (u0, v0, u1, v1), (left, top, _, _) = place.box, around[place.frame]
        first = start[place.frame] + (v0 - top) * width[place.frame] + u0 - left
        in_crop = covering.as_strided(
            (v1 - v0, u1 - u0), (width[place.frame] * num_words, num_words), first * num_words + word
        )
        # Every instance has a bit of its own, so adding is setting it.
        in_crop.add_(every_mask[place.instance][v0:v1, u0:u1] > MASK_THRESHOLD, alpha=1 << bit)
    return InstanceCrops(
        boxes.new_tensor(around).view(num_frames, 4),
        boxes.new_tensor(start[:-1]),
        covering,
        covering.new_tensor(bits).view(len(boxes), num_words),
    )


def _num_words(num_instances: int) -> int:
    """1, 4, 8, 16, ...: more than are needed, but each number of words is a compilation of whatever looks them up."""
    words = 1
    while words * _BITS_OF_A_WORD < num_instances:
        words = max(4, 2 * words)
    return words


class _Place(NamedTuple):
    """Where an instance is written."""

    instance: int
    frame: int
    box: tuple[int, int, int, int]
    rank: int  # among those of its frame


def _places(instances: Sequence[Sequence[int]], num_frames: int) -> tuple[list[_Place], list[tuple[int, ...]]]:
    """Places of the instances that are there, from their frames and boxes (N, 5), and the box around each frame's."""
    around: list[tuple[int, ...]] = [(0, 0, 0, 0)] * num_frames
    counts, places = [0] * num_frames, []
    for number, (frame, u0, v0, u1, v1) in enumerate(instances):
        if u1 <= u0:
            continue
        left, top, right, bottom = around[frame] if counts[frame] else (u0, v0, u1, v1)
        around[frame] = (min(left, u0), min(top, v0), max(right, u1), max(bottom, v1))
        places.append(_Place(number, frame, (u0, v0, u1, v1), counts[frame]))
        counts[frame] += 1
    return places, around
