"""Which pixels of a car are hidden by instances in front of it (paper, section "Occlusion Handling").

Occluders of a car are all instances of the same frame that stand in front of it and have a mask on that side: the
other detections, and `Detections.occluders` of any class. An occluder hides where its probability exceeds 0.5.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.observation.mask_extents import SceneExtents, scene_extents
from directshape_torch.observation.regions import MASK_THRESHOLD
from directshape_torch.scene import Detections

Side = Literal["left", "right"]
OcclusionOrder = Literal["depth", "box_bottom"]


def instances_in_front(
    detections: Detections,
    side: Side,
    order: OcclusionOrder = "depth",
) -> Tensor:
    """Which instance stands in front of which detection and has a mask that may hide it.

    Args:
        detections: B objects and M further occluders.
        side: image whose masks are asked for.
        order: "depth": smaller depth of the object's origin; a pair of which one depth is unknown (NaN, or not in
            front of the camera) falls back to the boxes. "box_bottom": lower bottom edge of the left 2D box, as in the
            paper. Equals, and comparisons with NaN, hide nothing.

    Returns:
        (B + M, B) bool: instance i (detections first, then occluders) is in front of detection j.

    Raises:
        InputError: unknown side or order.
    """
    if order not in ("depth", "box_bottom"):
        raise InputError("order", "'depth' or 'box_bottom'", repr(order))
    count = len(detections)
    frame, depth_m, bottom_v, present = _instances(detections, side)
    in_front = bottom_v[:, None] > bottom_v[None, :count]
    if order == "depth":
        known = depth_m > 0  # False for NaN
        nearer = depth_m[:, None] < depth_m[None, :count]
        in_front = torch.where(known[:, None] & known[None, :count], nearer, in_front)
    return in_front & (frame[:, None] == frame[None, :count]) & present[:, None]


@dataclass(frozen=True)
class OcclusionCrops:
    """What hides each object within a region of it: one lookup a point, however many instances are in front.

    Attributes:
        wanted: (B, 4) integer (u0, v0, u1, v1), half open: the regions.
        boxes: (B, 4) crops of the objects' frames, half open.
        table: (B, 6) integer, of each object: what its region has in common with the crop; the row of `covering` that
            pixel (0, 0) of its frame would have; the crop's width.
        in_front: (B, W) int32, bits of the instances in front of each object.
        covering: (A, W) int32, bits of the instances that cover each pixel, see `InstanceCrops`.
    """

    wanted: Tensor
    boxes: Tensor
    table: Tensor
    in_front: Tensor
    covering: Tensor

    @classmethod
    def of(cls, crops: InstanceCrops, in_front: Tensor, frame_index: Tensor, wanted: Tensor) -> OcclusionCrops:
        """From instances (N), which of them is in front (N, B), and frames (B,) and regions (B, 4) of the objects."""
        boxes = crops.boxes[frame_index]
        width = boxes[:, 2] - boxes[:, 0]
        corner = crops.start[frame_index] - boxes[:, 1] * width - boxes[:, 0]
        words = [torch.where(in_front, word[:, None], 0).sum(dim=0, dtype=word.dtype) for word in crops.bits.unbind(1)]
        table = torch.cat([_common(wanted, boxes), corner[:, None], width[:, None]], dim=1)
        return cls(wanted, boxes, table, torch.stack(words, dim=1), crops.covering)

    def within(self, wanted: Tensor) -> OcclusionCrops:
        """The same for other regions (B, 4) of the objects."""
        table = torch.cat([_common(wanted, self.boxes), self.table[:, 4:]], dim=1)
        return replace(self, wanted=wanted, table=table)

    def at(
        self,
        object_index: Tensor,  # (...)
        uv: Tensor,  # (..., 2)
    ) -> Tensor:
        """Whether the nearest pixel of each point is hidden; False outside of the object's region.

        Args:
            object_index: integer, broadcastable to (...).
            uv: (..., 2) pixels, integer or floating point (rounded half to even); NaN is not hidden.

        Returns:
            (...) bool.
        """
        if uv.is_floating_point():
            # Far beyond any image, but within the integers.
            uv = uv.round().nan_to_num(nan=-1.0, posinf=-1.0, neginf=-1.0).clamp(-1.0, 2.0**30)
        u, v = uv.long().unbind(-1)
        u0, v0, u1, v1, corner, width = _rows(self.table, object_index).unbind(-1)
        inside = (u >= u0) & (u < u1) & (v >= v0) & (v < v1)
        entry = torch.where(inside, corner + v * width + u, 0)
        return ((_rows(self.covering, entry) & _rows(self.in_front, object_index)) != 0).any(dim=-1) & inside

    def objects(self, chosen: slice) -> OcclusionCrops:
        """Those of some objects, which are numbered anew; `covering` is shared."""
        of_objects = ("wanted", "boxes", "table", "in_front")
        return replace(self, **{name: getattr(self, name)[chosen] for name in of_objects})

    def crop(self, index: int) -> Tensor:
        """The occlusion mask of one object in its region, (v1 - v0, u1 - u0) bool, for pictures."""
        u0, v0, u1, v1 = self.wanted[index].tolist()
        device = self.table.device
        v, u = (torch.arange(*ends, device=device) for ends in ((v0, v1), (u0, u1)))
        uv = torch.stack(torch.meshgrid(u, v, indexing="xy"), dim=-1)
        return self.at(torch.full((), index, device=device), uv)


def _rows(values: Tensor, index: Tensor) -> Tensor:
    """`values[index]`, rows (..., W) of values (R, W) at an index (...), in a third of the time."""
    return values.index_select(0, index.reshape(-1)).view(*index.shape, values.shape[1])


def _common(a: Tensor, b: Tensor) -> Tensor:
    """Intersections of half-open boxes (B, 4)."""
    return torch.cat([torch.maximum(a[:, :2], b[:, :2]), torch.minimum(a[:, 2:], b[:, 2:])], dim=1)


def occlusion_crops(
    detections: Detections,
    side: Side,
    regions: Tensor,  # (B, 4)
    order: OcclusionOrder = "depth",
) -> OcclusionCrops:
    """The paper's occlusion mask of every object within its region, for repeated lookups and for pictures.

    Args:
        detections: B objects.
        side: image whose masks are used.
        regions: (B, 4) integer (u0, v0, u1, v1), half open, as `region_boxes` gives them.
        order: see `instances_in_front`.

    Raises:
        InputError: `regions` is not (B, 4); unknown side or order.
    """
    if regions.shape != (len(detections), 4):
        raise InputError("regions", f"shape ({len(detections)}, 4)", f"{tuple(regions.shape)}", "use region_boxes")
    num_frames = int(detections.frame_index.max()) + 1 if len(detections) else 0
    others = detections.occluders
    if others is not None and len(others.frame_index):
        num_frames = max(num_frames, int(others.frame_index.max()) + 1)
    _masks(detections, side)
    return crops_of_sides(detections, (side,), scene_extents(detections), regions, num_frames, order)


def crops_of_sides(
    detections: Detections,
    sides: Sequence[Side],
    extents: SceneExtents,
    regions: Tensor,  # (S * B, 4)
    num_frames: int,
    order: OcclusionOrder = "depth",
) -> OcclusionCrops:
    """`occlusion_crops` of several sides at once: the B objects of the first side, then those of the next.

    Args:
        detections: B objects.
        sides: S images.
        extents: of the masks of these detections.
        regions: (S B, 4) integer, half open.
        num_frames: F.
        order: see `instances_in_front`.
    """
    in_front = [instances_in_front(detections, side, order) for side in sides]
    masks = [stack for side in sides for stack in _masks(detections, side)]
    # Instances that hide nobody are left out.
    boxes = [extents.boxes(s) * hides.any(dim=1)[:, None] for s, hides in zip(sides, in_front, strict=True)]
    frame = _instances(detections, sides[0])[0]
    frame_of_instance = torch.cat([frame + number * num_frames for number in range(len(sides))])
    frame_of_object = torch.cat([detections.frame_index + number * num_frames for number in range(len(sides))])
    crops = instance_crops(masks, torch.cat(boxes), frame_of_instance, num_frames * len(sides))
    # No side hides anything on another one.
    blocks = [
        torch.cat([h if k == n else torch.zeros_like(h) for k in range(len(sides))], dim=1)
        for n, h in enumerate(in_front)
    ]
    return OcclusionCrops.of(crops, torch.cat(blocks), frame_of_object, regions)


def _instances(detections: Detections, side: Side) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Frame, depth in metres, box bottom and presence of a mask of the B detections and then the M occluders."""
    frame = detections.frame_index
    depth_m, bottom_v = detections.T_cam_obj[:, 2, 3], detections.box_2d[:, 3]
    present = detections.has_mask_left if side == "left" else detections.has_mask_right
    others = detections.occluders
    if others is None:
        return frame, depth_m, bottom_v, present
    return (
        torch.cat([frame, others.frame_index]),
        torch.cat([depth_m, others.depth_m.to(depth_m.dtype)]),
        torch.cat([bottom_v, others.bottom_v.to(bottom_v.dtype)]),
        torch.cat([present, present.new_ones(len(others.frame_index))]),
    )


def _masks(detections: Detections, side: Side) -> list[Tensor]:
    if side not in ("left", "right"):
        raise InputError("side", "'left' or 'right'", repr(side))
    name = f"mask_{side}"
    sources = [detections] if detections.occluders is None else [detections, detections.occluders]
    masks: list[Tensor] = [getattr(source, name) for source in sources]
    if masks[-1].shape[1:] != masks[0].shape[1:]:
        raise InputError("occluders", f"masks of {tuple(masks[0].shape[1:])}", f"{tuple(masks[-1].shape[1:])}")
    return masks


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

    Examples:
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
