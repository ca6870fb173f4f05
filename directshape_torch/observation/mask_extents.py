"""Where instance masks have foreground: one pass over the masks, then only the rows that have any."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Literal

import torch
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.numerics.tensors import pixels_at_once, portions
from directshape_torch.observation.regions import MASK_THRESHOLD
from directshape_torch.scene import Detections

# Resampling by cubic kernels overshoots by a quarter at an edge; logits and 0..255 go far beyond.
_HIGHEST_PROBABILITY = 1.5


@dataclass(frozen=True)
class MaskExtents:
    """Extents of I masks.

    Attributes:
        boxes: (I, 4) integer (u0, v0, u1, v1), half open, of the pixels above `MASK_THRESHOLD`; all 0 without any.
        areas: (I,) integer, foreground pixels; NaN counts, to be noticed later. 0 where the mask is absent.
    """

    boxes: Tensor
    areas: Tensor

    def covers(self) -> Tensor:
        """Whether there is any pixel above the threshold, (I,) bool."""
        return self.boxes[:, 2] > self.boxes[:, 0]


@dataclass(frozen=True)
class SceneExtents:
    """Extents of all masks of a call: B detections and M further occluders, in both images."""

    left: MaskExtents
    right: MaskExtents
    occluders_left: MaskExtents
    occluders_right: MaskExtents

    def boxes(self, side: Literal["left", "right"]) -> Tensor:
        """Boxes (B + M, 4) of all instances of one image, detections first."""
        if side == "left":
            return torch.cat([self.left.boxes, self.occluders_left.boxes])
        return torch.cat([self.right.boxes, self.occluders_right.boxes])

    def areas(self) -> Tensor:
        """Foreground pixels (B, 2) of the left and right masks of the detections."""
        return torch.stack([self.left.areas, self.right.areas], dim=1)


def scene_extents(detections: Detections) -> SceneExtents:
    """Extents of every mask of a call, of detections and of occluders.

    Args:
        detections: B cars, with M further occluders or without. Absent masks are not read.

    Raises:
        InputError: occluders of another size, or masks with values above 1.5.
    """
    d, others = detections, detections.occluders
    if others is not None and others.mask_left.shape[1:] != d.mask_left.shape[1:]:
        got = tuple(others.mask_left.shape[1:])
        raise InputError("occluders", f"masks of {tuple(d.mask_left.shape[1:])}", f"{got}")
    masks, present = [d.mask_left, d.mask_right], [d.has_mask_left, d.has_mask_right]
    names = ["detections.mask_left", "detections.mask_right"]
    if others is not None and len(others.frame_index):
        masks += [others.mask_left, others.mask_right]
        present += [torch.ones_like(others.frame_index, dtype=torch.bool)] * 2
        names += ["detections.occluders.mask_left", "detections.occluders.mask_right"]
    extents = mask_extents(masks, present, names)
    if len(extents) == 2:
        nothing = MaskExtents(extents[0].boxes[:0], extents[0].areas[:0])
        extents += [nothing, nothing]
    return SceneExtents(*extents)


def mask_extents(
    masks: Sequence[Tensor], present: Sequence[Tensor], names: Sequence[str] | None = None
) -> list[MaskExtents]:
    """Extents of several stacks of masks, with one host synchronisation in all.

    Args:
        masks: stacks (I, H, W) of foreground probabilities, or 0 and 1 in bool; I may differ.
        present: (I,) bool of each stack; absent masks have no extent.
        names: of the stacks, for errors.

    Raises:
        InputError: wrong shapes, or values above 1.5 in a row of pixels without NaN.

    Examples:
        >>> mask = torch.zeros(1, 6, 8)
        >>> mask[0, 2:4, 3:8] = 0.9
        >>> (extents,) = mask_extents([mask], [torch.tensor([True])])
        >>> extents.boxes.tolist(), extents.areas.tolist()
        ([[3, 2, 8, 4]], [10])
    """
    for stack, exists in zip(masks, present, strict=True):
        if stack.ndim != 3 or len(stack) != len(exists) or stack.shape[1:] != masks[0].shape[1:]:
            size = ", ".join(str(length) for length in masks[0].shape[1:]) if masks[0].ndim == 3 else "H, W"
            raise InputError("masks", f"shape ({len(exists)}, {size})", f"{tuple(stack.shape)}")
    stacks, lengths = [_comparable(stack) for stack in masks], [len(stack) for stack in masks]
    highest = [stack.amax(dim=2) for stack in stacks]
    in_rows = torch.cat([rows > MASK_THRESHOLD for rows in highest]) & torch.cat(list(present))[:, None]
    top, bottom = _first_and_end(in_rows)
    has_nan = torch.stack([(rows != rows).any() for rows in highest])
    # The maxima are at hand, so what is no probability costs no further look at the masks, and no further wait.
    too_high = torch.stack([_too_high(rows, exists).any() for rows, exists in zip(highest, present, strict=True)])
    on_host = torch.cat([top, bottom, torch.cat([has_nan, too_high]).long()]).tolist()
    *spans, nan_flags, high_flags = _split(on_host, (len(top), len(top), len(stacks), len(stacks)))
    if any(high_flags):
        wrong = high_flags.index(1)
        _raise_too_high("masks" if names is None else names[wrong], highest[wrong], present[wrong])
    rows = list(zip(*spans, strict=True))
    columns, numbers = [], iter(rows)
    for stack in stacks:
        columns.append(_foreground_of_columns(stack, [next(numbers) for _ in stack]))
    # Absent masks had their share of the rows of others.
    foreground = torch.cat(columns) * (bottom > 0)[:, None]
    left, right = _first_and_end(foreground > 0)
    boxes = torch.stack([left, top, right, bottom], dim=1).split_with_sizes(lengths)
    areas = foreground.sum(dim=1, dtype=torch.float64).long().split_with_sizes(lengths)
    return [
        _plain_extents(stack, exists) if unknown else MaskExtents(*extents)
        for *extents, stack, exists, unknown in zip(boxes, areas, stacks, present, nan_flags, strict=True)
    ]


def _split(numbers: list[int], lengths: Sequence[int]) -> list[list[int]]:
    ends = list(accumulate(lengths))
    return [numbers[end - length : end] for length, end in zip(lengths, ends, strict=True)]


def _too_high(
    highest: Tensor,  # (I, H) maximum of each row of pixels
    present: Tensor,  # (I,) bool
) -> Tensor:
    """Rows (I, H) of masks that are there which hold more than a probability; bool masks never do."""
    if not highest.is_floating_point():
        return torch.zeros_like(highest, dtype=torch.bool)
    return (highest > _HIGHEST_PROBABILITY) & present[:, None]


def _raise_too_high(name: str, highest: Tensor, present: Tensor) -> None:
    values = highest.where(_too_high(highest, present), torch.zeros_like(highest)).amax(dim=1)
    row = int(values.argmax())
    got = f"a value of {float(values[row]):g} in mask {row}"
    raise InputError(name, "foreground probabilities in [0, 1]", got, "apply a sigmoid to logits, or divide by 255")


def _comparable(masks: Tensor) -> Tensor:
    """The same memory, in a type of which maxima are fast."""
    return masks.view(torch.uint8) if masks.dtype == torch.bool else masks.detach()


def _foreground_of_columns(
    masks: Tensor,  # (I, H, W) without NaN
    rows: Sequence[tuple[int, int]],  # first row with foreground and the one behind the last; 0, 0 without any
) -> Tensor:
    """Foreground pixels (I, W) of each column: neighbours in the stack together, in the rows of them all."""
    count, _, width = masks.shape
    foreground = torch.zeros(count, width, dtype=torch.float32, device=masks.device)
    amounts = [(bottom - top) * width for top, bottom in rows]
    for part in portions(amounts, pixels_at_once(masks.device) // 2):
        if not any(amounts[part]):
            continue
        tops, bottoms = zip(*(span for span in rows[part] if span[1]), strict=True)
        window = masks[part, min(tops) : max(bottoms)]
        if masks.dtype == torch.uint8:
            foreground[part] = window.sum(dim=1, dtype=torch.int32)
            continue
        # Floating-point flags: comparing into them and summing them up is many times faster than with bool ones.
        background = torch.le(window, MASK_THRESHOLD, out=torch.empty(window.shape, device=masks.device))
        torch.sub(window.shape[1], background.sum(dim=1), out=foreground[part])
    return foreground


def _plain_extents(masks: Tensor, present: Tensor) -> MaskExtents:
    """Extents of masks (I, H, W) with NaN, which covers nothing but has an area."""
    covered = (masks > MASK_THRESHOLD) & present[:, None, None]
    (u0, u1), (v0, v1) = _first_and_end(covered.any(dim=1)), _first_and_end(covered.any(dim=2))
    areas = (~(masks <= MASK_THRESHOLD) & present[:, None, None]).sum(dim=(1, 2))
    return MaskExtents(torch.stack([u0, v0, u1, v1], dim=1), areas)


def _first_and_end(
    flags: Tensor,  # (I, L)
) -> tuple[Tensor, Tensor]:
    """Position of the first True of each row, and behind its last one; 0 and 0 where there is none."""
    length = flags.shape[1]
    position = torch.arange(length, device=flags.device)
    first = torch.where(flags, position, length).amin(dim=1)
    return first % length, torch.where(flags, position + 1, 0).amax(dim=1)
