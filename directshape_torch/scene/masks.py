"""This module keeps instance masks as crops: of each mask only the box around the non-zero pixels is kept."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate
from typing import Annotated, Any, Self, Union

import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.numerics.checks import check_shape
from directshape_torch.numerics.conversion import Given, as_tensor
from directshape_torch.numerics.records import Dense, TensorRecord

MASK_THRESHOLD = 0.5
"""An instance covers a pixel where its foreground probability is above this threshold."""

Masks = Union[Tensor, NDArray[Any], Sequence[Tensor | NDArray[Any] | None], "MaskCrops"]
"""Users give masks of B instances as (B, H, W), as B entries that are (H, W) or None, or as crops."""

# Resampling by cubic kernels overshoots by a quarter at an edge; logits and 0..255 go far beyond.
_LOWEST_PROBABILITY, _HIGHEST_PROBABILITY = -0.5, 1.5


@dataclass(frozen=True)
class MaskCrops(TensorRecord):
    """`MaskCrops` are the masks of B instances in images of one size; outside of its box a mask is zero.

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
        object.__setattr__(self, "size_hw", (height, width))
        fits = all(0 <= u0 <= u1 <= width and 0 <= v0 <= v1 <= height for u0, v0, u1, v1 in self._boxes)
        if not fits or self._starts[-1] != len(self.values):
            expected = f"half open boxes within {width} x {height} pixels that have {len(self.values)} pixels together"
            raise InputError("boxes", expected, str(self._boxes), "make crops with MaskCrops.of")

    @classmethod
    def of(cls, masks: Masks, present: Given | None = None, name: str = "masks") -> Self:
        """Crops of masks in any form that users have.

        Args:
            masks: (B, H, W) or B entries that are (H, W) or None, tensors or numpy arrays, or crops: bool, uint8 (0 and
                1 where nothing in the array is larger, else 0..255), or foreground probability. Masks that require
                gradients are kept whole, because zeros have gradients, too.
            present: (B,) bool, which masks are there; other masks are not read. None means that all are there.
            name: name of the argument, for errors.

        Raises:
            InputError: no masks of one size, another dtype, or values above 1.5.
        """
        if isinstance(masks, cls):
            return masks if present is None else masks.where(_flags(name, present, len(masks)))
        masks = masks if isinstance(masks, (list, tuple)) else as_tensor(masks)
        entries = _entries(name, masks)
        first = next(mask for mask in (*entries, masks) if isinstance(mask, Tensor))
        if present is not None:
            here = _flags(name, present, len(entries)).tolist()
            entries = [mask if flag else None for mask, flag in zip(entries, here, strict=True)]
        used = _foreground([mask for mask in entries if mask is not None], together=isinstance(masks, Tensor))
        supports = _supports(used)
        known = iter(supports)
        boxes = [[0, 0, 0, 0] if mask is None else next(known) for mask in entries]
        parts = [mask[v0:v1, u0:u1] for mask, (u0, v0, u1, v1) in zip(used, supports, strict=True)]
        like = first.new_zeros(0, dtype=torch.bool if first.dtype == torch.uint8 else first.dtype)
        height, width = (int(n) for n in first.shape[-2:])
        return cls._checked(name, parts, boxes, (height, width), like)

    @classmethod
    def of_boxes(
        cls, crops: Sequence[tuple[Given, Tensor | NDArray[Any]]], size_hw: tuple[int, int], like: Tensor
    ) -> Self:
        """Crops of masks that are known inside of boxes alone, as mask heads give them.

        Args:
            crops: for each instance the box u0, v0, u1, v1, half open, whole pixels within the image, and the mask
                (v1 - v0, u1 - u0) inside, of the dtypes that `of` takes; an instance without a mask has a box without
                an area.
            size_hw: height and width of the images, pixels.
            like: a tensor of the wanted device and dtype, which is floating point where a mask is soft.

        Raises:
            InputError: a box that leaves the image or is not in whole pixels, a mask of another size than its box,
                another dtype, or values above 1.5.

        Examples:
            >>> head = torch.rand(1, 1, 28, 28)
            >>> inside = torch.nn.functional.interpolate(head, size=(30, 80), mode="bilinear")[0, 0]
            >>> MaskCrops.of_boxes([((100, 50, 180, 80), inside)], (120, 400), head).dense().shape
            torch.Size([1, 120, 400])
        """
        boxes = _whole_boxes([box for box, _ in crops])
        parts = [as_tensor(pixels) for _, pixels in crops]
        for row, ((u0, v0, u1, v1), part) in enumerate(zip(boxes, parts, strict=True)):
            _check_mask(f"crops[{row}]", part, (v1 - v0, u1 - u0), "the mask is (v1 - v0, u1 - u0) of its box")
        parts = _foreground(parts)
        check_shape("like", like, [f"n{axis}" for axis in range(like.ndim)], kind="mask")
        if like.dtype == torch.bool and any(part.is_floating_point() and part.numel() for part in parts):
            raise InputError("like", "floating point, which soft masks need", str(like.dtype), "give a float tensor")
        return cls._checked("crops", [part.to(like) for part in parts], boxes, size_hw, like)

    @classmethod
    def _checked(
        cls, name: str, parts: Sequence[Tensor], boxes: list[list[int]], size_hw: tuple[int, int], like: Tensor
    ) -> Self:
        """Make crops of the pixels in B boxes; raise `InputError` where numbers are no probabilities."""
        values = torch.cat([part.reshape(-1) for part in parts]) if parts else like.new_zeros(0)
        crops = cls(values, torch.tensor(boxes, dtype=torch.int64, device=like.device).reshape(-1, 4), size_hw)
        if values.dtype != torch.bool and values.numel():
            known = values.detach().nan_to_num(0.0, posinf=torch.inf, neginf=-torch.inf)
            lowest, highest = torch.stack(known.aminmax()).tolist()
            if highest > _HIGHEST_PROBABILITY or lowest < _LOWEST_PROBABILITY:
                value = highest if highest > _HIGHEST_PROBABILITY else lowest
                row = bisect_right(crops._starts, int((known == value).int().argmax())) - 1
                cure = "apply a sigmoid to logits, or divide by 255"
                got = f"a value of {value:g} in mask {row}"
                raise InputError(name, "foreground probabilities in [0, 1]", got, cure)
        return crops

    @classmethod
    def none(cls, count: int, size_hw: tuple[int, int], like: Tensor) -> Self:
        """Crops of `count` instances without masks, with the dtype and device of `like`."""
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
        row = range(len(self))[row]
        u0, v0, u1, v1 = self._boxes[row]
        # The view is made anew each time, because a view from a region without gradients would have none later.
        return self.values.narrow(0, self._starts[row], (v1 - v0) * (u1 - u0)).view(v1 - v0, u1 - u0)

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
        parts = [self.crop(row).view(-1) for row in index.tolist()]
        values = torch.cat(parts) if parts else self.values[:0]
        return type(self)(values, self.boxes.index_select(0, index.to(self.boxes.device)), self.size_hw)

    def where(self, present: Tensor) -> Self:
        """The masks where `present` (B,) holds; other instances have no mask."""
        check_shape("present", present, (len(self),), kind="flags")
        parts = [self.crop(row).view(-1) for row, here in enumerate(present.tolist()) if here]
        values = torch.cat(parts) if parts else self.values[:0]
        return type(self)(values, self.boxes * present[:, None].to(self.boxes), self.size_hw)

    def above(self, end: Tensor) -> Self:
        """The masks without what lies in row `end` (B,) of the image or below it."""
        boxes = self.boxes.clone()
        boxes[:, 3] = boxes[:, 3].minimum(end.to(boxes)).maximum(boxes[:, 1])
        heights = (boxes[:, 3] - boxes[:, 1]).tolist()
        parts = [self.crop(row)[:height].reshape(-1) for row, height in enumerate(heights)]
        return type(self)(torch.cat(parts) if parts else self.values, boxes, self.size_hw)

    def padded(self, size_hw: tuple[int, int]) -> Self:
        """The masks in images that are padded at the right and bottom."""
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
        """Boxes (B, 4) int64 around the pixels above one half or NaN, half open, 0 without any."""
        return self._foreground[0]

    @property
    def areas(self) -> Tensor:
        """Numbers (B,) of pixels above one half or NaN."""
        return self._foreground[1]

    @cached_property
    def _boxes(self) -> list[list[int]]:
        return self.boxes.tolist()

    @cached_property
    def _starts(self) -> list[int]:
        """Places of the first pixel of each box among the values, and their number."""
        return [0, *accumulate((u1 - u0) * (v1 - v0) for u0, v0, u1, v1 in self._boxes)]

    @cached_property
    def _first(self) -> Tensor:
        """Place (B,) of the first pixel of each box among the values."""
        return torch.tensor(self._starts[:-1], dtype=torch.int64, device=self.boxes.device)

    @cached_property
    def _foreground(self) -> tuple[Tensor, Tensor]:
        crops = [~(self.crop(row).detach() <= MASK_THRESHOLD) for row in range(len(self))]
        boxes = self.boxes.long()
        if not crops:
            return boxes, boxes[:, 0]
        return _extents(crops, boxes[:, :2]), torch.stack([crop.sum() for crop in crops])


def _extents(
    crops: Sequence[Tensor],  # B of (h, w)
    corners: Tensor,  # (B, 2) u and v of the upper left pixel of each crop
) -> Tensor:
    """Boxes (B, 4) int64 around non-zero pixels, half open, 0 without any."""
    u0, u1 = _first_and_end([_any(crop, 0) for crop in crops], corners[:, 0])
    v0, v1 = _first_and_end([_any(crop, 1) for crop in crops], corners[:, 1])
    return torch.stack([u0, v0, u1, v1], dim=1)


def _any(mask: Tensor, dim: int) -> Tensor:
    """The result of `mask.any(dim)`, by the maximum of bytes, which is seven times as fast."""
    if mask.dtype != torch.bool or not mask.shape[dim]:
        return mask.any(dim=dim)
    return mask.view(torch.uint8).amax(dim=dim).bool()


def _first_and_end(
    flags: Sequence[Tensor],  # B of (L,)
    start: Tensor,  # (B,)
) -> tuple[Tensor, Tensor]:
    """Positions (B,) of the first True of each row and behind the last one, from `start` on; 0 and 0 without any."""
    every = torch.cat(list(flags))
    lengths = torch.tensor([len(part) for part in flags], device=every.device)
    owner = torch.arange(len(lengths), device=every.device).repeat_interleave(lengths, output_size=len(every))
    position = torch.arange(len(every), device=every.device) - (lengths.cumsum(0) - lengths - start)[owner]
    beyond = torch.iinfo(torch.int64).max
    none = torch.full_like(start, beyond)
    first = none.scatter_reduce(0, owner, torch.where(every, position, beyond), "amin")
    end = torch.zeros_like(start).scatter_reduce(0, owner, torch.where(every, position + 1, 0), "amax")
    return torch.where(first == beyond, 0, first), end


def _flags(name: str, present: Given, count: int) -> Tensor:
    """Flags (B,) that say which masks are there."""
    flags = as_tensor(present)
    # An empty list has no dtype of its own.
    flags = flags.bool() if isinstance(flags, Tensor) and flags.shape == (0,) else flags
    check_shape(f"has_{name}", flags, (count,), kind="flags")
    return flags


def _entries(name: str, masks: Tensor | Sequence[Tensor | NDArray[Any] | None]) -> list[Tensor | None]:
    """Each mask (H, W) as it is given, or None."""
    if isinstance(masks, Tensor):
        _check_mask(name, masks, ("B", "H", "W"))
        return list(masks)
    if not isinstance(masks, (list, tuple)):
        expected = "masks (B, H, W), or B entries that are (H, W) or None"
        raise InputError(name, expected, type(masks).__name__, "stack the masks of the cars")
    entries = [None if mask is None else as_tensor(mask) for mask in masks]
    given = [mask for mask in entries if mask is not None]
    for row, mask in enumerate(entries):
        if mask is not None:
            _check_mask(f"{name}[{row}]", mask, ("H", "W"))
    sizes = {tuple(mask.shape) for mask in given}
    if len(sizes) != 1:
        got = f"{len(masks)} entries of sizes {sorted(sizes)}"
        cure = "where no car has a mask give MaskCrops.none(number of cars, (H, W), like=boxes)"
        raise InputError(name, "masks of one size (H, W), or None where a car has none", got, cure)
    return entries


def _check_mask(name: str, mask: Tensor, shape: Sequence[int | str], cure: str = "") -> None:
    """Raise `InputError` unless `mask` is a mask of bytes or of a dtype that masks may have in a call."""
    is_bytes = isinstance(mask, Tensor) and mask.dtype == torch.uint8
    check_shape(name, mask, shape, cure, "number" if is_bytes else "mask")


def _foreground(masks: Sequence[Tensor], together: bool = False) -> list[Tensor]:
    """The masks with bytes turned into bool (0 and 1) or probabilities (shades of grey).

    `together` says that all masks have shades of grey where one has.
    """
    of_bytes = [mask for mask in masks if mask.dtype == torch.uint8]
    has_shades = torch.stack([(mask > 1).any() for mask in of_bytes]).tolist() if of_bytes else []
    is_grey = iter([any(has_shades)] * len(of_bytes) if together else has_shades)

    def converted(mask: Tensor) -> Tensor:
        if mask.dtype != torch.uint8:
            return mask
        return mask.float() / 255 if next(is_grey) else mask.bool()

    return [converted(mask) for mask in masks]


def _whole_boxes(boxes: Sequence[Given]) -> list[list[int]]:
    """Boxes u0, v0, u1, v1, half open; raises `InputError` for one that is none in whole pixels."""
    tensors = [as_tensor(box) for box in boxes]
    for row, tensor in enumerate(tensors):
        check_shape(f"crops[{row}]", tensor, (4,), "give its box u0, v0, u1, v1 first")
    # One wait for the device serves all boxes.
    numbers = torch.stack([tensor.double() for tensor in tensors]).tolist() if tensors else []
    for row, (u0, v0, u1, v1) in enumerate(numbers):
        if not all(number.is_integer() for number in (u0, v0, u1, v1)) or u1 < u0 or v1 < v0:
            expected = "a box u0, v0, u1, v1 in whole pixels, half open"
            cure = "round its corners before you resample the mask to its size"
            raise InputError(f"crops[{row}]", expected, str([u0, v0, u1, v1]), cure)
    return [[int(number) for number in box] for box in numbers]


def _supports(masks: Sequence[Tensor]) -> list[list[int]]:
    """Boxes u0, v0, u1, v1 around non-zero pixels; the whole image where zeros need gradients."""
    plain = [mask for mask in masks if not mask.requires_grad]
    # One wait for the device serves all masks.
    found = iter(_extents(plain, plain[0].new_zeros(len(plain), 2, dtype=torch.int64)).tolist() if plain else [])
    return [[0, 0, mask.shape[1], mask.shape[0]] if mask.requires_grad else next(found) for mask in masks]
