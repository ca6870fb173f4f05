"""Which pixels of a car are hidden by instances in front of it (paper, section "Occlusion Handling").

Occluders of a car are all instances of the same frame that stand in front of it and have a mask on that side: the
other detections, and `Detections.occluders` of any class. An occluder hides where its probability exceeds 0.5.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.observation.instance_crops import InstanceCrops, instance_crops
from directshape_torch.observation.mask_extents import SceneExtents, scene_extents
from directshape_torch.observation.regions import MASK_THRESHOLD
from directshape_torch.scene import Detections

Side = Literal["left", "right"]
OcclusionOrder = Literal["depth", "box_bottom"]


def hidden_pixels(
    detections: Detections,
    side: Side,
    object_index: Tensor,  # (P,)
    uv: Tensor,  # (P, 2)
    order: OcclusionOrder = "depth",
) -> Tensor:
    """Whether each pixel of an object is covered by the mask of an instance in front of it.

    Args:
        detections: B objects, with further occluders or without.
        side: image that the pixels and the masks belong to.
        object_index: (P,) integer, the object that each pixel belongs to.
        uv: (P, 2) integer pixels (column, row). Pixels outside the mask images are not hidden.
        order: see `instances_in_front`.

    Returns:
        (P,) bool.

    Raises:
        InputError: wrong shapes, non-integer pixels, unknown side or order.
    """
    if uv.ndim != 2 or uv.shape[-1] != 2 or uv.is_floating_point():
        raise InputError("uv", "integer pixels (P, 2)", f"{tuple(uv.shape)} {uv.dtype}", "round them")
    if object_index.shape != uv.shape[:1]:
        raise InputError("object_index", f"shape ({len(uv)},)", f"{tuple(object_index.shape)}", "one entry a pixel")
    height, width = detections.mask_left.shape[1:]
    inside = (uv >= 0).all(dim=1) & (uv[:, 0] < width) & (uv[:, 1] < height)
    pixel = torch.where(inside, uv[:, 1] * width + uv[:, 0], 0)
    in_front = instances_in_front(detections, side, order)
    hidden = torch.zeros_like(inside)
    first = 0
    for masks in _masks(detections, side):
        covered = _covered(masks, in_front[first : first + len(masks)], object_index, pixel)
        hidden |= covered
        first += len(masks)
    return hidden & inside


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


def _covered(
    masks: Tensor,  # (I, H, W)
    in_front: Tensor,  # (I, B)
    object_index: Tensor,  # (P,)
    pixel: Tensor,  # (P,) row-major within an image
) -> Tensor:
    """Whether any instance in front covers each pixel: as many lookups as the worst car has occluders."""
    covered = torch.zeros_like(pixel, dtype=torch.bool)
    num_ranks = int(in_front.sum(dim=0).max()) if in_front.numel() else 0
    if not len(pixel) or not num_ranks:
        return covered
    occluders = in_front.to(torch.uint8).argsort(dim=0, descending=True, stable=True)[:num_ranks]
    exists = in_front.gather(0, occluders)
    flat, image_size = masks.reshape(-1), masks.shape[1] * masks.shape[2]
    for instance, is_real in zip(occluders, exists, strict=True):
        (concerned,) = is_real[object_index].nonzero(as_tuple=True)
        entry = instance[object_index[concerned]] * image_size + pixel[concerned]
        covered[concerned] |= flat.index_select(0, entry) > MASK_THRESHOLD
    return covered
