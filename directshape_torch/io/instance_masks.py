"""Instances of one image, their masks, and which detection each belongs to, one to one in each image.

Left image: overlap of 2D boxes. Right image: overlap with the initial 3D box projected into it, never the instance
numbers of the file, which few tools share between the two images.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from directshape_torch.errors import DataFormatError
from directshape_torch.io.image_files import read_single_channel
from directshape_torch.scene_check.image_boxes import box_iou

Side = Literal["left", "right"]
# All masks of an image together: four bytes each where they are soft.
_MOST_PIXELS = 2**30
SIDES: tuple[Side, Side] = ("left", "right")
MIN_OVERLAP = 0.3
# Two masks of one image that share more than this are the same object seen twice by the segmentation.
DUPLICATE_MASK_IOU = 0.5


class MaskSizeError(DataFormatError):
    """A mask has another size than its image."""


@dataclass(frozen=True)
class InstanceMask:
    """One instance in one image."""

    side: Side  # the image, "left" or "right"
    instance_id: int  # its number in the file; numbers of the two images need not agree
    is_car: bool  # whether it may be matched to a car
    # The file's 2D box (u_min, v_min, u_max, v_max), else that of the mask, pixels.
    box: tuple[float, float, float, float]
    # The smallest box around the mask, whole pixels, both ends belonging to it.
    mask_box: tuple[float, float, float, float]
    probability: NDArray[np.bool_] | NDArray[np.float32]  # (H, W), bool or float32 foreground probability in [0, 1]
    score: float  # the segmentation's, 1 where there is none
    # Number of the car over the frames of its sequence, -1 where `instance_id` is of one frame alone.
    track_id: int = -1


def instance_of(
    side: Side,
    instance_id: int,
    probability: NDArray[np.bool_] | NDArray[np.float32],
    *,
    is_car: bool,
    box: tuple[float, float, float, float] | None = None,
    score: float = 1.0,
    track_id: int = -1,
) -> InstanceMask | None:
    """An instance, whose box is that of its mask where the file has none; None without a pixel above one half."""
    mask_box = tight_box(probability)
    if mask_box is None:  # an empty mask says nothing about a car
        return None
    return InstanceMask(side, instance_id, is_car, box or mask_box, mask_box, probability, score, track_id)


class MaskSource(Protocol):
    """Where the masks of a frame come from."""

    def read(self, frame_id: str, size_hw: tuple[int, int]) -> list[InstanceMask]:
        """Masks of both images of a frame whose images have `size_hw` pixels."""

    def files(self, frame_id: str) -> tuple[Path, ...]:
        """The files that `read` opens for a frame, so that a run can tell when they change."""


def file_of_frame(directory: Path, name: str) -> Path:
    """`directory/name`, or `directory/data/name` where that exists."""
    nested = directory / "data" / name
    return nested if nested.is_file() else directory / name


def tight_box(probability: NDArray[Any]) -> tuple[float, float, float, float] | None:
    """The smallest box around the pixels above one half, or None where there are none.

    Examples:
        >>> tight_box(np.eye(4) > 0)
        (0.0, 0.0, 3.0, 3.0)
    """
    mask = probability if probability.dtype == np.bool_ else probability > 0.5
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return None
    return float(columns[0]), float(rows[0]), float(columns[-1]), float(rows[-1])


def read_soft_mask(path: Path, size_hw: tuple[int, int]) -> NDArray[np.float32]:
    """A PNG of foreground probability x 255 (or x 65535, with 16 bits), (H, W) in [0, 1].

    Raises:
        DataFormatError: it is missing, damaged, or has several channels.
        MaskSizeError: it has another size than its image.
    """
    grey = read_single_channel(path)
    check_size(path, "the soft mask", grey.shape, size_hw)
    return np.asarray(grey.astype(np.float32) / np.float32(np.iinfo(grey.dtype).max))


def check_count(path: Path, count: int, size_hw: tuple[int, int]) -> None:
    """Raise `DataFormatError` where so many masks of one image would not fit into memory."""
    height, width = size_hw
    if count * height * width > _MOST_PIXELS:
        raise DataFormatError(
            path,
            f"{count} instances of {width} x {height} pixels, at most {_MOST_PIXELS // (height * width)} are read",
            cure="keep the likely ones",
        )


def check_size(path: Path, what: str, got_hw: Iterable[int], expected_hw: tuple[int, int]) -> None:
    """Raise `MaskSizeError` naming both sizes unless a mask has the size of its image."""
    got = tuple(int(n) for n in got_hw)
    if got != tuple(expected_hw):
        raise MaskSizeError(
            path,
            f"{what} has {got[1]} x {got[0]} pixels (width x height), its image {expected_hw[1]} x {expected_hw[0]}",
            cure="make masks at the size of the images",
        )


@dataclass(frozen=True)
class MaskMatches:
    """Masks of B detections in one image."""

    mask_of_detection: NDArray[np.int64]  # (B,) index into the list of masks, -1 for none
    overlap: NDArray[np.float64]  # (B,) the overlap of the matched boxes, 0 for none


def match_one_to_one(
    overlap: NDArray[np.float64],  # (B, M)
) -> MaskMatches:
    """The assignment of largest total overlap (Hungarian) that uses pairs of at least 0.3 only.

    Examples:
        >>> match_one_to_one(np.array([[0.9, 0.8], [0.7, 0.1]])).mask_of_detection.tolist()
        [1, 0]
    """
    from scipy.optimize import linear_sum_assignment

    allowed = np.where(overlap >= MIN_OVERLAP, overlap, 0.0)
    rows, columns = linear_sum_assignment(allowed, maximize=True)
    used = allowed[rows, columns] > 0
    index = np.full(len(overlap), -1, dtype=np.int64)
    value = np.zeros(len(overlap))
    index[rows[used]] = columns[used]
    value[rows[used]] = allowed[rows[used], columns[used]]
    return MaskMatches(index, value)


def match_masks(
    boxes_2d: NDArray[np.float64],  # (B, 4) in the image of the masks, pixels
    masks: Sequence[InstanceMask],
    further_boxes_2d: NDArray[np.float64] | None = None,  # (B, 4) a second opinion, NaN where there is none
) -> MaskMatches:
    """Match masks of one image to 2D boxes, by the larger of the overlaps with the file's box and the mask's own.

    The file's box (that of the 2D detector) may reach over parts that are hidden, as a 3D detector's box does; the
    mask's own box fits detectors whose boxes enclose what is visible. Either is evidence enough.

    Args:
        boxes_2d: where each detection is expected.
        masks: instances of one side.
        further_boxes_2d: another expectation for each detection; the larger overlap counts.
    """
    file_boxes, mask_boxes = (
        np.array([getattr(mask, name) for mask in masks], dtype=np.float64).reshape(-1, 4)
        for name in ("box", "mask_box")
    )
    expected = [boxes_2d] if further_boxes_2d is None else [boxes_2d, further_boxes_2d]
    overlaps = [np.nan_to_num(box_iou(a, b)) for a in expected for b in (file_boxes, mask_boxes)]
    return match_one_to_one(np.maximum.reduce(overlaps))


def without_duplicates(masks: Sequence[InstanceMask], matched: Sequence[InstanceMask]) -> list[InstanceMask]:
    """Those of some masks that belong to no detection which are no second mask of a matched car."""
    return [
        mask
        for mask in masks
        if not any(mask.side == k.side and _mask_iou(mask, k) > DUPLICATE_MASK_IOU for k in matched)
    ]


def _mask_iou(a: InstanceMask, b: InstanceMask) -> float:
    if box_iou(np.array([a.mask_box]), np.array([b.mask_box]))[0, 0] == 0.0:
        return 0.0
    in_a, in_b = a.probability > 0.5, b.probability > 0.5
    return float((in_a & in_b).sum() / max(1, (in_a | in_b).sum()))
