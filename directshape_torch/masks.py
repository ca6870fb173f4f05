"""Instance masks as crops: of each mask only the box around what is not zero is kept."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, Self, Union

import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.numerics.checks import check_shape
from directshape_torch.numerics.conversion import Given, as_tensor
from directshape_torch.numerics.records import Dense, TensorRecord

MASK_THRESHOLD = 0.5
"""Foreground probability above which an instance covers a pixel."""

Masks = Union[Tensor, NDArray[Any], Sequence[Tensor | NDArray[Any] | None], "MaskCrops"]
"""Masks of B instances as users have them: (B, H, W), B entries that are (H, W) or None, or crops."""

# Resampling by cubic kernels overshoots by a quarter at an edge; logits and 0..255 go far beyond.
_LOWEST_PROBABILITY, _HIGHEST_PROBABILITY = -0.5, 1.5


@dataclass(frozen=True)
class MaskCrops(TensorRecord):
    """The masks of B instances in images of one size; outside of its box a mask is zero.

    Attributes:
        values: (P,) the pixels of all boxes, row by row, one box after the other; bool or foreground probability.
        boxes: (B, 4) int64 or int32 u0, v0, u1, v1, half open, pixels; an instance without a mask has an empty box.
        size_hw: height and width of the images, pixels.

    Raises:
        InputError: boxes that leave the image or do not have as many pixels as there are values.

    Examples:
        >>> mask = torch.zeros(1, 120, 400, dtype=torch.bool)
        >>> mask[0, 50:80, 100:180] = True
        >>> crops = MaskCrops.of(mask)
        >>> crops.boxes.tolist(), len(crops.values), crops.dense().equal(mask)
        ([[100, 50, 180, 80]], 2400, True)
    """

    values: Annotated[Tensor, Dense("P", kind="mask")]
    boxes: Annotated[Tensor, Dense("B", 4, kind="index")]
    size_hw: tuple[int, int]

    def __post_init__(self) -> None:
        super().__post_init__()
        height, width = self.size_hw
        fits = all(0 <= u0 <= u1 <= width and 0 <= v0 <= v1 <= height for u0, v0, u1, v1 in self._boxes)
        if not fits or sum(self._counts) != len(self.values):
            expected = f"half open boxes within {width} x {height} pixels that have {len(self.values)} pixels together"
            raise InputError("boxes", expected, str(self._boxes), "make crops with MaskCrops.of")

    @classmethod
    def of(cls, masks: Masks, present: Given | None = None, name: str = "masks") -> Self:
        """Crops of masks as users have them.

        Args:
            masks: (B, H, W) or B entries that are (H, W) or None, tensors or numpy arrays, or crops: bool, uint8 (0 and
                1, or 0..255), or foreground probability. Masks that require gradients are kept whole, for zeros have
                one too.
            present: (B,) bool, masks that are there; the others are not read. None: all of them are there.
            name: of the argument, for errors.

        Raises:
            InputError: no masks of one size, another dtype, or values above 1.5.
        """
        if isinstance(masks, cls):
            return masks if present is None else masks.where(as_tensor(present))
        masks = masks if isinstance(masks, (list, tuple)) else as_tensor(masks)
        entries = _entries(name, masks)
        exists = [True] * len(entries)
        if present is not None:
            present = as_tensor(present)
            check_shape(f"has_{name}", present, (len(entries),), kind="flags")
            exists = present.tolist()
        used = [mask if here else None for mask, here in zip(entries, exists, strict=True)]
        like = next(mask for mask in (*entries, masks) if isinstance(mask, Tensor))
        boxes = [(0, 0, 0, 0) if mask is None else _support(mask) for mask in used]
        values = [
            _checked(name, row, mask[v0:v1, u0:u1])
            for row, (mask, (u0, v0, u1, v1)) in enumerate(zip(used, boxes, strict=True))
            if mask is not None
        ]
        height, width = (int(n) for n in like.shape[-2:])
        return cls(
            torch.cat([part.reshape(-1) for part in values]) if values else like.new_zeros(0),
            torch.tensor(boxes, dtype=torch.int64, device=like.device).reshape(-1, 4),
            (height, width),
        )

    @classmethod
    def of_boxes(cls, crops: Sequence[tuple[Sequence[int], Tensor]], size_hw: tuple[int, int], like: Tensor) -> Self:
        """Masks that are known inside of boxes alone, as mask heads give them.

        Args:
            crops: of each instance the box u0, v0, u1, v1, half open, whole pixels within the image, and the mask
                (v1 - v0, u1 - u0) in it; a box without an area for an instance without a mask.
            size_hw: height and width of the images, pixels.
            like: gives dtype and device.

        Raises:
            InputError: a box that leaves the image, or a mask of another size than its box.

        Examples:
            >>> head = torch.rand(1, 1, 28, 28)
            >>> inside = torch.nn.functional.interpolate(head, size=(30, 80), mode="bilinear")[0, 0]
            >>> MaskCrops.of_boxes([((100, 50, 180, 80), inside)], (120, 400), head).dense().shape
            torch.Size([1, 120, 400])
        """
        values = [pixels.reshape(-1).to(like) for _, pixels in crops]
        boxes = torch.tensor([list(box) for box, _ in crops], dtype=torch.int64, device=like.device)
        return cls(torch.cat(values) if values else like.new_zeros(0), boxes.reshape(-1, 4), size_hw)

    @classmethod
    def none(cls, count: int, size_hw: tuple[int, int], like: Tensor) -> Self:
        """No mask for so many instances, with the dtype and device of `like`."""
        return cls(like.new_zeros(0), torch.zeros(count, 4, dtype=torch.int64, device=like.device), size_hw)

    def __len__(self) -> int:
        return len(self.boxes)

    def __getitem__(self, row: int) -> Tensor:
        """One mask (H, W), zero where there is none."""
        u0, v0, u1, v1 = self._boxes[row]
        height, width = self.size_hw
        return torch.nn.functional.pad(self.crop(row), (u0, width - u1, v0, height - v1))

    def __iter__(self) -> Iterator[Tensor]:
        return (self[row] for row in range(len(self)))

    def crop(self, row: int) -> Tensor:
        """The pixels (h, w) of one mask inside its box."""
        u0, v0, u1, v1 = self._boxes[row]
        return self._parts[row].view(v1 - v0, u1 - u0)

    def dense(self) -> Tensor:
        """All masks (B, H, W), zero where there is none."""
        return torch.stack(list(self)) if len(self) else self.values.new_zeros(0, *self.size_hw)

    def at(self, row: Tensor, u: Tensor, v: Tensor) -> Tensor:
        """The values (...) of masks `row` (...) at pixels of integer u and v (...); zero outside of the boxes."""
        u0, v0, u1, v1 = self.boxes[row].unbind(-1)
        inside = (u >= u0) & (u < u1) & (v >= v0) & (v < v1)
        if not len(self.values):
            return self.values.new_zeros(inside.shape)
        place = self._first[row] + (v - v0) * (u1 - u0) + u - u0
        values = self.values[torch.where(inside, place, 0)]
        return torch.where(inside, values, torch.zeros_like(values))

    def rows(self, index: Tensor) -> Self:
        """The masks `index` (M,) int64, in that order."""
        parts = [self._parts[row] for row in index.tolist()]
        values = torch.cat(parts) if parts else self.values[:0]
        return type(self)(values, self.boxes.index_select(0, index.to(self.boxes.device)), self.size_hw)

    def where(self, present: Tensor) -> Self:
        """The masks where `present` (B,) holds; the other instances have none."""
        parts = [part if here else part[:0] for part, here in zip(self._parts, present.tolist(), strict=True)]
        values = torch.cat(parts) if parts else self.values
        return type(self)(values, self.boxes * present[:, None].to(self.boxes), self.size_hw)

    def padded(self, size_hw: tuple[int, int]) -> Self:
        """The same masks in images that are padded at the right and bottom."""
        return type(self)(self.values, self.boxes, size_hw)

    @classmethod
    def joined(cls, records: Sequence[Self]) -> Self:
        """The masks of several records one after the other; raises `InputError` where images differ in size."""
        sizes = list(dict.fromkeys(record.size_hw for record in records))
        if len(sizes) > 1:
            raise InputError("records", "masks of images of one size", str(sizes), "pad them with padded(size_hw)")
        values, boxes = (torch.cat([getattr(record, name) for record in records]) for name in ("values", "boxes"))
        return cls(values, boxes, sizes[0])

    @property
    def box_2d(self) -> Tensor:
        """u_min, v_min, u_max, v_max (B, 4) of the pixels above one half, float64; NaN without any."""
        box = torch.cat([self.extents[:, :2], self.extents[:, 2:] - 1], dim=1).double()
        return torch.where(self.areas[:, None] > 0, box, torch.nan)

    @property
    def extents(self) -> Tensor:
        """Boxes (B, 4) int64 around the pixels above one half, half open, 0 without any; a NaN is above."""
        return self._foreground[0]

    @property
    def areas(self) -> Tensor:
        """Pixels (B,) above one half; a NaN is above."""
        return self._foreground[1]

    @cached_property
    def _boxes(self) -> list[list[int]]:
        return self.boxes.tolist()

    @cached_property
    def _counts(self) -> list[int]:
        return [(u1 - u0) * (v1 - v0) for u0, v0, u1, v1 in self._boxes]

    @cached_property
    def _parts(self) -> tuple[Tensor, ...]:
        return torch.split(self.values, self._counts) if self._counts else ()

    @cached_property
    def _first(self) -> Tensor:
        """Place (B,) of the first pixel of each box among the values."""
        counts = torch.tensor(self._counts, dtype=torch.int64, device=self.boxes.device)
        return counts.cumsum(0) - counts

    @cached_property
    def _foreground(self) -> tuple[Tensor, Tensor]:
        crops = [~(self.crop(row).detach() <= MASK_THRESHOLD) for row in range(len(self))]
        if not crops:
            return self.boxes.long(), self.boxes[:, 0].long()
        boxes = self.boxes.long()
        u0, u1 = _first_and_end([crop.any(dim=0) for crop in crops], boxes[:, 0])
        v0, v1 = _first_and_end([crop.any(dim=1) for crop in crops], boxes[:, 1])
        return torch.stack([u0, v0, u1, v1], dim=1), torch.stack([crop.sum() for crop in crops])


def _first_and_end(
    flags: Sequence[Tensor],  # B of (L,)
    start: Tensor,  # (B,)
) -> tuple[Tensor, Tensor]:
    """Position (B,) of the first True of each row, and behind its last one, from `start` on; 0 and 0 without any."""
    every = torch.cat(list(flags))
    lengths = torch.tensor([len(part) for part in flags], device=every.device)
    owner = torch.arange(len(lengths), device=every.device).repeat_interleave(lengths, output_size=len(every))
    position = torch.arange(len(every), device=every.device) - (lengths.cumsum(0) - lengths - start)[owner]
    beyond = torch.iinfo(torch.int64).max
    none = torch.full_like(start, beyond)
    first = none.scatter_reduce(0, owner, torch.where(every, position, beyond), "amin")
    end = torch.zeros_like(start).scatter_reduce(0, owner, torch.where(every, position + 1, 0), "amax")
    return torch.where(first == beyond, 0, first), end


def _entries(name: str, masks: Masks) -> list[Tensor | None]:
    """Each mask (H, W) in bool or floating point, or None."""
    if isinstance(masks, Tensor):
        check_shape(name, masks, ("B", "H", "W"))
        return list(_foreground(name, masks))
    if not isinstance(masks, (list, tuple)):
        expected = "masks (B, H, W), or B entries that are (H, W) or None"
        raise InputError(name, expected, type(masks).__name__, "stack the masks of the cars")
    entries: list[Tensor | None] = []
    for row, mask in enumerate(masks):
        if mask is None:
            entries.append(None)
            continue
        tensor = as_tensor(mask)
        check_shape(f"{name}[{row}]", tensor, ("H", "W"))
        entries.append(_foreground(f"{name}[{row}]", tensor))
    sizes = {tuple(mask.shape) for mask in entries if mask is not None}
    if len(sizes) != 1:
        got = f"{len(entries)} entries of sizes {sorted(sizes)}"
        cure = "where no car has a mask give MaskCrops.none(number of cars, (H, W), like=boxes)"
        raise InputError(name, "masks of one size (H, W), or None where a car has none", got, cure)
    dtypes = {mask.dtype for mask in entries if mask is not None}
    if len(dtypes) > 1:
        entries = [None if mask is None else mask.float() for mask in entries]
    return entries


def _foreground(name: str, masks: Tensor) -> Tensor:
    """Masks in bytes, 0 and 1 or shades of grey, as bool or probabilities; others as they are."""
    if masks.dtype == torch.uint8:
        return masks.bool() if not masks.numel() or int(masks.max()) <= 1 else masks.float() / 255
    check_shape(name, masks, [f"n{axis}" for axis in range(masks.ndim)], kind="mask")
    return masks


def _support(mask: Tensor) -> tuple[int, int, int, int]:
    """The box u0, v0, u1, v1 around what is not zero; the whole image where gradients are asked of the zeros."""
    if mask.requires_grad:
        return 0, 0, mask.shape[1], mask.shape[0]
    on = mask if mask.dtype == torch.bool else mask != 0
    rows = on.any(dim=1).nonzero()[:, 0].tolist()
    if not rows:
        return 0, 0, 0, 0
    top, bottom = rows[0], rows[-1] + 1
    columns = on[top:bottom].any(dim=0).nonzero()[:, 0].tolist()
    return columns[0], top, columns[-1] + 1, bottom


def _checked(name: str, row: int, mask: Tensor) -> Tensor:
    """The mask itself; raises `InputError` where it holds other numbers than probabilities."""
    if mask.dtype != torch.bool and mask.numel():
        known = mask.detach().nan_to_num(0.0, posinf=torch.inf, neginf=-torch.inf)
        lowest, highest = (float(value) for value in known.aminmax())
        if highest > _HIGHEST_PROBABILITY or lowest < _LOWEST_PROBABILITY:
            got = f"a value of {highest if highest > _HIGHEST_PROBABILITY else lowest:g} in mask {row}"
            cure = "apply a sigmoid to logits, or divide by 255"
            raise InputError(name, "foreground probabilities in [0, 1]", got, cure)
    return mask
