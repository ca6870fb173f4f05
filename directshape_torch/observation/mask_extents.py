"""Where instance masks have foreground: one pass over the masks, then only the rows that have any."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.observation.portions import pixels_at_once, portions
from directshape_torch.observation.regions import MASK_THRESHOLD
from directshape_torch.scene import Detections


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
    """
    d, others = detections, detections.occluders
    masks, present = [d.mask_left, d.mask_right], [d.has_mask_left, d.has_mask_right]
    if others is not None and len(others.frame_index):
        masks += [others.mask_left, others.mask_right]
        present += [torch.ones_like(others.frame_index, dtype=torch.bool)] * 2
    extents = mask_extents(masks, present)
    if len(extents) == 2:
        nothing = MaskExtents(extents[0].boxes[:0], extents[0].areas[:0])
        extents += [nothing, nothing]
    return SceneExtents(*extents)


def mask_extents(masks: Sequence[Tensor], present: Sequence[Tensor]) -> list[MaskExtents]:
    """Extents of several stacks of masks, with one host synchronisation in all.

    Args:
        masks: stacks (I, H, W) of foreground probabilities or bool; I may differ.
        present: (I,) bool of each stack; absent masks have no extent.

    Example:
        >>> mask = torch.zeros(1, 6, 8)
        >>> mask[0, 2:4, 3:8] = 0.9
        >>> (extents,) = mask_extents([mask], [torch.tensor([True])])
        >>> extents.boxes.tolist(), extents.areas.tolist()
        ([[3, 2, 8, 4]], [10])
    """
    for stack, exists in zip(masks, present, strict=True):
        if stack.ndim != 3 or len(stack) != len(exists):
            raise InputError("masks", f"shape ({len(exists)}, H, W)", f"{tuple(stack.shape)}")
    stacks = [_comparable(stack) for stack in masks]
    spans, unknown = [], []
    for stack, exists in zip(stacks, present, strict=True):
        highest = stack.amax(dim=2)
        spans.append(torch.stack(_first_and_end((highest > MASK_THRESHOLD) & exists[:, None]), dim=1))
        unknown.append((highest != highest).any())
    rows = iter(torch.cat([*(span.flatten() for span in spans), torch.stack(unknown).long()]).tolist())
    spans_on_host = [[(next(rows), next(rows)) for _ in stack] for stack in stacks]
    return [
        _plain_extents(stack, exists) if next(rows) else _extents(stack, span, tops_and_bottoms)
        for stack, exists, span, tops_and_bottoms in zip(stacks, present, spans, spans_on_host, strict=True)
    ]


def _comparable(masks: Tensor) -> Tensor:
    """The same memory, in a type of which maxima are fast."""
    return masks.view(torch.uint8) if masks.dtype == torch.bool else masks.detach()


def _extents(
    masks: Tensor,  # (I, H, W) without NaN
    span: Tensor,  # (I, 2) first row with foreground and the one behind the last; 0, 0 without any
    tops_and_bottoms: Sequence[tuple[int, int]],  # the same on the host
) -> MaskExtents:
    """Extents from the rows that have foreground: neighbours in the stack together, in the rows of them all."""
    count, _, width = masks.shape
    foreground = torch.zeros(count, width, dtype=torch.float32, device=masks.device)
    amounts = [(bottom - top) * width for top, bottom in tops_and_bottoms]
    for part in portions(amounts, pixels_at_once(masks.device) // 2):
        tops, bottoms = zip(
            *(rows for rows in tops_and_bottoms[part] if rows[1] or not any(amounts[part])), strict=True
        )
        window = masks[part, min(tops) : max(bottoms)]
        # Floating-point flags: comparing into them and summing them up is many times faster than with bool ones.
        background = torch.le(window, MASK_THRESHOLD, out=torch.empty(window.shape, device=masks.device))
        torch.sub(window.shape[1], background.sum(dim=1), out=foreground[part])
    # Absent masks had their share of the rows of others.
    foreground *= span[:, 1:] > 0
    u0, u1 = _first_and_end(foreground > 0)
    boxes = torch.stack([u0, span[:, 0], u1, span[:, 1]], dim=1)
    return MaskExtents(boxes, foreground.sum(dim=1, dtype=torch.float64).long())


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
