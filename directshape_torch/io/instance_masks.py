"""Instances of one image and their masks, whatever files they come from (`mask_files`)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from directshape_torch.errors import DataFormatError
from directshape_torch.io.image_files import read_single_channel

Side = Literal["left", "right"]
# All masks of an image together: four bytes each where they are soft.
_MOST_PIXELS = 2**30
SIDES: tuple[Side, Side] = ("left", "right")


class MaskSizeError(DataFormatError):
    """A mask has another size than its image."""


@dataclass(frozen=True)
class InstanceMask:
    """One instance in one image.

    Attributes:
        side: the image, "left" or "right".
        instance_id: its number in the file; numbers of the two images need not agree.
        category_id: class number in the file's own numbering.
        is_car: whether that class may be matched to a car.
        box: the file's 2D box (u_min, v_min, u_max, v_max), else that of the mask, pixels.
        mask_box: the smallest box around the mask, whole pixels, both ends belonging to it.
        probability: (H, W), bool or float32 foreground probability in [0, 1].
        score: the segmentation's, 1 where there is none.
        track_id: number of the car over the frames of its sequence, -1 where `instance_id` is of one frame alone.
    """

    side: Side
    instance_id: int
    category_id: int
    is_car: bool
    box: tuple[float, float, float, float]
    mask_box: tuple[float, float, float, float]
    probability: NDArray[np.bool_] | NDArray[np.float32]
    score: float
    track_id: int = -1


class MaskSource(Protocol):
    """Where the masks of a frame come from."""

    def read(self, frame_id: str, size_hw: tuple[int, int]) -> list[InstanceMask]:
        """Masks of both images of a frame whose images have `size_hw` pixels."""
        ...

    def files(self, frame_id: str) -> tuple[Path, ...]:
        """The files that `read` opens for a frame, so that a run can tell when they change."""
        ...


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
