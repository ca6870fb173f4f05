"""Where masks have foreground, and the region around each car: the part of an image that can speak about it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.scene import MASK_THRESHOLD, Detections

# Resampling by cubic kernels overshoots by a quarter at an edge; logits and 0..255 go far beyond.
_HIGHEST_PROBABILITY = 1.5
_MARGIN_PX, _MARGIN_SHARE = 4.0, 0.1


class MaskExtents(NamedTuple):
    """Extents of I masks."""

    boxes: Tensor  # (I, 4) integer (u0, v0, u1, v1), half open, around the foreground; all 0 without any
    areas: Tensor  # (I,) foreground pixels


class SceneExtents(NamedTuple):
    """Extents of all masks of a call: B detections, then M further occluders."""

    boxes_left: Tensor  # (B + M, 4)
    boxes_right: Tensor  # (B + M, 4)
    areas: Tensor  # (B, 2) foreground pixels of the left and right masks of the detections


def scene_extents(detections: Detections) -> SceneExtents:
    """Extents of every mask of a call, of detections and of occluders; absent masks are not read.

    Raises:
        InputError: occluders of another size, or masks with values above 1.5.
    """
    d, others = detections, detections.occluders
    masks, present = [d.mask_left, d.mask_right], [d.has_mask_left, d.has_mask_right]
    names = ["detections.mask_left", "detections.mask_right"]
    if others is not None and len(others.frame_index):
        masks += [others.mask_left, others.mask_right]
        present += [torch.ones_like(others.frame_index, dtype=torch.bool)] * 2
        names += ["detections.occluders.mask_left", "detections.occluders.mask_right"]
    left, right, *of_others = mask_extents(masks, present, names)
    boxes_left, boxes_right = (
        torch.cat([own.boxes, *(x.boxes for x in of_others[side::2])]) for side, own in enumerate((left, right))
    )
    return SceneExtents(boxes_left, boxes_right, torch.stack([left.areas, right.areas], dim=1))


def mask_extents(
    masks: Sequence[Tensor], present: Sequence[Tensor], names: Sequence[str] = ("masks",)
) -> list[MaskExtents]:
    """Extents of stacks of masks (I, H, W), none where `present` (I,) is false; a NaN counts as foreground.

    Raises:
        InputError: stacks of different sizes, or values above 1.5; `names` are those of the stacks.
    """
    _check_sizes(masks, names)
    # The same memory, in a type of which maxima are fast.
    stacks = [stack.view(torch.uint8) if stack.dtype == torch.bool else stack.detach() for stack in masks]
    exists = iter(torch.cat(list(present)).tolist())
    highest = [_row_maxima(stack, [next(exists) for _ in stack]) for stack in stacks]
    _check_probabilities(highest, names)
    v0, v1 = _first_and_end(torch.cat([_is_foreground(rows) for rows in highest]))
    every_mask = [mask for stack in stacks for mask in stack]
    # From here on what has foreground alone is read.
    strips = [mask[top:end] for mask, top, end in zip(every_mask, *torch.stack([v0, v1]).tolist(), strict=True)]
    nothing = torch.zeros(masks[0].shape[2], dtype=torch.bool, device=v0.device)
    in_columns = [_is_foreground(strip.amax(dim=0)) if len(strip) else nothing for strip in strips]
    u0, u1 = _first_and_end(torch.stack(in_columns) if strips else nothing[None][:0])
    spans = zip(strips, *torch.stack([u0, u1]).tolist(), strict=True)
    areas = torch.stack([v0.new_zeros(()), *(_is_foreground(strip[:, left:end]).sum() for strip, left, end in spans)])
    lengths = [len(stack) for stack in stacks]
    boxes = torch.stack([u0, v0, u1, v1], dim=1).split_with_sizes(lengths)
    return [MaskExtents(*part) for part in zip(boxes, areas[1:].split_with_sizes(lengths), strict=True)]


def _row_maxima(stack: Tensor, present: Sequence[bool]) -> Tensor:
    """Of each row of masks, (I, H); 0 for those that are not there, whose memory is left alone."""
    nothing = stack.new_zeros(stack.shape[1])
    rows = [mask.amax(dim=1) if exists else nothing for mask, exists in zip(stack, present, strict=True)]
    return torch.stack(rows) if rows else stack[:, :, 0]


def _is_foreground(values: Tensor) -> Tensor:
    return ~(values <= MASK_THRESHOLD)


def _first_and_end(
    flags: Tensor,  # (I, L)
) -> tuple[Tensor, Tensor]:
    """Position of the first True of each row, and behind its last one; 0 and 0 where there is none."""
    length = flags.shape[1]
    position = torch.arange(length, device=flags.device)
    first = torch.where(flags, position, length).amin(dim=1)
    return first % length, torch.where(flags, position + 1, 0).amax(dim=1)


def _check_sizes(masks: Sequence[Tensor], names: Sequence[str]) -> None:
    height, width = masks[0].shape[1:]
    for name, stack in zip(names, masks, strict=True):
        if stack.shape[1:] != (height, width):
            raise InputError(name, f"masks of the size of {names[0]} {(height, width)}", f"{tuple(stack.shape[1:])}")


def _check_probabilities(highest: Sequence[Tensor], names: Sequence[str]) -> None:
    """Raise `InputError` for more than a probability in the maxima (I, H) of the rows of masks."""
    if not bool(torch.stack([(rows > _HIGHEST_PROBABILITY).any() for rows in highest]).any()):
        return
    name, rows = next(x for x in zip(names, highest, strict=True) if (x[1] > _HIGHEST_PROBABILITY).any())
    values = rows.nan_to_num(0.0, posinf=torch.inf).amax(dim=1)
    row = int(values.argmax())
    got = f"a value of {float(values[row]):g} in mask {row}"
    raise InputError(name, "foreground probabilities in [0, 1]", got, "apply a sigmoid to logits, or divide by 255")


def region_boxes(
    boxes: Tensor,  # (B, 4)
    mask_boxes: Tensor,  # (B, 4)
    sizes: Tensor,  # (B, 2)
) -> Tensor:
    """The region (B, 4) on one side whose pixels can speak about each car: integer, half open, 0 where nothing is left.

    The mask's box (all 0: none) joined with the given one (NaN, or outside of the image: none), grown on every side by
    the larger of 4 px and a tenth of its width (or height) and clipped to the image, so that a shape that spills out of
    its mask pays for it.
    """
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
