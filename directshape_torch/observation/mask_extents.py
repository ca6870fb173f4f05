"""Where instance masks have foreground: one pass over the masks, then only the rows that have any."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from directshape_torch.errors import InputError
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
    """Extents of several stacks of masks, with two host synchronisations in all.

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
    # `~(x <= t)` is also true for NaN, which the maximum hands on.
    in_rows = [
        ~(stack.amax(dim=2) <= MASK_THRESHOLD) & exists[:, None] for stack, exists in zip(stacks, present, strict=True)
    ]
    counts = torch.stack([rows.sum() for rows in in_rows]).tolist()
    rows = torch.cat([rows.flatten() for rows in in_rows]).nonzero()[:, 0]
    extents, first = [], 0
    for stack, of_stack in zip(stacks, torch.split_with_sizes(rows, counts), strict=True):
        extents.append(_extents_of_rows(stack, of_stack - first))
        first += stack.shape[0] * stack.shape[1]
    return extents


def _comparable(masks: Tensor) -> Tensor:
    """The same memory, in a type of which maxima are fast."""
    return masks.view(torch.uint8) if masks.dtype == torch.bool else masks.detach()


def _extents_of_rows(
    masks: Tensor,  # (I, H, W)
    rows: Tensor,  # (R,) row-major among I * H, ascending
) -> MaskExtents:
    count, height, width = masks.shape
    number = torch.div(rows, height, rounding_mode="floor")
    lines = masks.flatten(0, 1).index_select(0, rows)
    flags = torch.empty(lines.shape, dtype=torch.float32, device=lines.device)
    # Floating-point flags: comparing into them and summing them up is many times faster than with bool ones.
    covered = torch.gt(lines, MASK_THRESHOLD, out=flags)
    in_columns = torch.zeros(count, width, dtype=torch.float32, device=rows.device).index_add_(0, number, covered) > 0
    in_rows = torch.zeros(count, height, dtype=torch.bool, device=rows.device)
    in_rows.flatten()[rows] = covered.sum(dim=1) > 0
    background = torch.le(lines, MASK_THRESHOLD, out=flags).sum(dim=1).long()
    areas = torch.zeros(count, dtype=torch.long, device=rows.device).index_add_(0, number, width - background)
    (u0, u1), (v0, v1) = _first_and_end(in_columns), _first_and_end(in_rows)
    return MaskExtents(torch.stack([u0, v0, u1, v1], dim=1), areas)


def _first_and_end(
    flags: Tensor,  # (I, L)
) -> tuple[Tensor, Tensor]:
    """Position of the first True of each row, and behind its last one; 0 and 0 where there is none."""
    length = flags.shape[1]
    position = torch.arange(length, device=flags.device)
    first = torch.where(flags, position, length).amin(dim=1)
    return first % length, torch.where(flags, position + 1, 0).amax(dim=1)
