"""This module holds instances of one image with their masks and decodes soft PNG, COCO run lengths and polygons."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from directshape_torch.errors import DataFormatError, shown
from directshape_torch.files.find_files import found
from directshape_torch.io.image_files import read_single_channel
from directshape_torch.scene.frames import Side
from directshape_torch.scene.masks import MASK_THRESHOLD

Box = tuple[float, float, float, float]
"""This is (u_min, v_min, u_max, v_max), pixels."""

# The crops of all masks of a frame together may have this many pixels; soft masks need four bytes for each.
_MOST_PIXELS = 2**28
# No real outline is longer. Rasterising needs memory for each pixel of an outline, also outside the image.
_LONGEST_OUTLINE_PX = 1e6
# A run fits into 32 bits, which come in groups of five.
_MOST_GROUPS = 7


class MaskSizeError(DataFormatError):
    """A mask has another size than its image."""


@dataclass(frozen=True)
class InstanceMask:
    """An `InstanceMask` is one instance in one image, given by the part of the image that contains it."""

    side: Side  # the image, "left" or "right"
    instance_id: int  # its number in the file; numbers of the two images need not agree
    is_car: bool  # whether it may be matched to a car
    corner: tuple[int, int]  # u and v of the upper left pixel of the part
    probability: NDArray[np.bool_] | NDArray[np.float32]  # (h, w), bool or float32 foreground probability in [0, 1]
    score: float = 1.0  # confidence of the segmentation, in [0, 1]
    # Number of the car in all frames of its sequence; -1 if `instance_id` is valid for one frame only.
    track_id: int = -1
    # The index of the detection that the file names for it, from 0; None if the mask is matched by overlap.
    row: int | None = None

    @classmethod
    def found(
        cls, side: Side, instance_id: int, is_car: bool, probability: NDArray[Any], **known: Any
    ) -> InstanceMask | None:
        """The instance of a mask (H, W) of a whole image, or None if no pixel is above one half.

        Examples:
            >>> mask = np.zeros((100, 200), bool)
            >>> mask[40:50, 60:90] = True
            >>> InstanceMask.found("left", 1, True, mask).mask_box
            (60.0, 40.0, 89.0, 49.0)
        """
        if not (probability > MASK_THRESHOLD).any():
            return None
        rows, columns = (np.flatnonzero((probability != 0).any(axis=axis)) for axis in (1, 0))
        part = probability[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        return cls(side, instance_id, is_car, (int(columns[0]), int(rows[0])), part.copy(), **known)

    @cached_property
    def inside(self) -> NDArray[np.bool_]:
        """Pixels (h, w) of the part that are above one half."""
        return np.asarray(self.probability > MASK_THRESHOLD)

    @cached_property
    def mask_box(self) -> Box:
        """The smallest box around the pixels above one half, with both ends included."""
        rows, columns = (np.flatnonzero(self.inside.any(axis=axis)) for axis in (1, 0))
        u, v = self.corner
        return float(u + columns[0]), float(v + rows[0]), float(u + columns[-1]), float(v + rows[-1])

    @property
    def crop_box(self) -> tuple[int, int, int, int]:
        """The part as u0, v0, u1, v1, where u1 and v1 are excluded."""
        (u, v), (height, width) = self.corner, self.probability.shape
        return u, v, u + width, v + height

    def whole(self, size_hw: tuple[int, int]) -> NDArray[np.bool_]:
        """The pixels (H, W) of the whole image that are above one half."""
        image, (u0, v0, u1, v1) = np.zeros(size_hw, dtype=bool), self.crop_box
        image[v0:v1, u0:u1] = self.inside
        return image


class MaskSource(Protocol):
    """A `MaskSource` provides the masks of frames."""

    def read(self, frame_id: str, size_hw: tuple[int, int]) -> list[InstanceMask]:
        """Masks of both images of a frame whose images have `size_hw` pixels."""

    def files(self, frame_id: str) -> tuple[Path, ...]:
        """The files that `read` opens for a frame, so that a run can detect changes."""


def file_of_frame(directory: Path, name: str) -> Path:
    """`directory/data/name` or `directory/name`, whichever exists, else the latter."""
    return found(directory / "data" / name) or found(directory / name) or directory / name


def read_mask(path: Path, where: str, mask: Any, size_hw: tuple[int, int], root: Path) -> NDArray[Any]:
    """A mask (H, W) from its entry in a file, as bool or foreground probability in [0, 1].

    Args:
        path, where: the file and the place in it, named in errors.
        mask: the path, relative to `root`, of a PNG of probability x 255 (or x 65535 with 16 bits), or a COCO
            segmentation.
        size_hw: size of the image.
        root: folder of the PNG files.

    Raises:
        DataFormatError: the PNG is missing, damaged, or has several channels, or `decode_segmentation` raises.
        MaskSizeError: the mask has another size than its image.
    """
    if not isinstance(mask, str):
        return decode_segmentation(path, where, mask, size_hw)
    grey = read_single_channel(root / mask)
    check_size(root / mask, "the soft mask", grey.shape, size_hw)
    return np.asarray(grey.astype(np.float32) / np.float32(np.iinfo(grey.dtype).max))


def within_memory(path: Path, masks: Iterable[InstanceMask | None]) -> list[InstanceMask]:
    """The masks of a frame; a `DataFormatError` is raised if they would not fit into memory."""
    kept, pixels = list[InstanceMask](), 0
    for mask in masks:
        if mask is not None:
            kept.append(mask)
            pixels += mask.probability.size
        if pixels > _MOST_PIXELS:
            problem = f"the first {len(kept)} instances cover over {_MOST_PIXELS} pixels"
            raise DataFormatError(path, problem, cure="keep the likely ones")
    return kept


def check_size(path: Path, what: str, got_hw: Iterable[int], expected_hw: tuple[int, int]) -> None:
    """Raise `MaskSizeError` naming both sizes unless a mask has the size of its image."""
    got = tuple(int(n) for n in got_hw)
    if got != tuple(expected_hw):
        raise MaskSizeError(
            path,
            f"{what} has {got[1]} x {got[0]} pixels (width x height), its image {expected_hw[1]} x {expected_hw[0]}",
            cure="make masks at the size of the images",
        )


def decode_segmentation(path: Path, where: str, segmentation: Any, size_hw: tuple[int, int]) -> NDArray[np.bool_]:
    """A binary mask from the `segmentation` of a COCO result.

    Args:
        path, where: the file and the entry's place in it, named in errors.
        segmentation: RLE `{"size": [H, W], "counts": str | bytes | list}`, or a list of polygons `[x0, y0, x1, y1,
            ..]`. Polygons without an area (fewer than three points) and None cover no pixels.
        size_hw: size of the image.

    Raises:
        MaskSizeError: run lengths are of another size than the image.
        DataFormatError: the segmentation has neither form, runs do not add up to the size, or polygons lie far outside
            the image.

    Examples:
        >>> rle = {"size": [2, 3], "counts": [2, 3, 1]}  # down the columns: 2 off, 3 on, 1 off
        >>> decode_segmentation(Path("masks.json"), "entry 0", rle, (2, 3)).astype(int).tolist()
        [[0, 1, 1], [0, 1, 0]]
    """
    if isinstance(segmentation, Mapping) and "counts" in segmentation and "size" in segmentation:
        size = segmentation["size"]
        if not isinstance(size, (list, tuple)) or len(size) != 2 or not all(type(n) is int for n in size):
            raise DataFormatError(path, f"{where}: bad run lengths ('size' is {shown(size)}, expected [height, width])")
        check_size(path, f"{where}: the mask", size, size_hw)
        return _from_runs(path, where, segmentation["counts"], size_hw)
    if segmentation is None or (isinstance(segmentation, list) and all(map(_is_polygon, segmentation))):
        # Tools write outlines of one or two points, or nothing, for instances without an area.
        with_area = [polygon for polygon in segmentation or [] if len(polygon) >= 6 and len(polygon) % 2 == 0]
        if not with_area:
            return np.zeros(size_hw, dtype=bool)
        return _from_runs(path, where, _outlined(path, where, with_area, size_hw), size_hw)
    raise DataFormatError(
        path,
        f"{where}: 'segmentation' is neither RLE nor a list of polygons",
        cure='write {"size": [H, W], "counts": ..}, or [[x0, y0, x1, y1, x2, y2, ..]]',
    )


def _from_runs(path: Path, where: str, counts: Any, size_hw: tuple[int, int]) -> NDArray[np.bool_]:
    height, width = size_hw
    try:
        runs = _runs(counts)
    except ValueError as error:
        raise DataFormatError(path, f"{where}: bad run lengths ({error})") from error
    if sum(runs) != height * width:
        raise DataFormatError(
            path,
            f"{where}: run lengths cover {sum(runs)} pixels, expected {height} x {width} = {height * width}",
            cure="the file is damaged, or 'size' is not [height, width]",
        )
    is_on = np.arange(len(runs)) % 2 == 1
    return np.ascontiguousarray(np.repeat(is_on, runs).reshape(width, height).T)


def _runs(counts: Any) -> Sequence[int]:
    """Run lengths as numbers of at least 0; `ValueError` is raised for anything else."""
    if isinstance(counts, (str, bytes)):
        runs = _run_lengths(_unprinted(counts).encode("ascii") if isinstance(counts, str) else counts)
    elif isinstance(counts, list) and all(_is_number(run) and float(run).is_integer() for run in counts):
        runs = [int(run) for run in counts]
    else:
        raise ValueError(f"'counts' is {shown(counts)}, expected text or a list of whole numbers")
    if min(runs, default=0) < 0:
        raise ValueError(f"a run of {min(runs)} pixels")
    return runs


def _unprinted(counts: str) -> str:
    """Counts without the `b'..'` around printed bytes; the encoding itself has no quotation marks."""
    is_printed = counts.startswith(("b'", 'b"')) and counts.endswith(("'", '"'))
    return counts[2:-1].replace("\\\\", "\\") if is_printed else counts


def _outlined(path: Path, where: str, polygons: Sequence[Sequence[float]], size_hw: tuple[int, int]) -> bytes:
    """The run lengths of the pixels that polygons cover."""
    import pycocotools.mask

    for polygon in polygons:
        corners = np.array(polygon, dtype=np.float64).reshape(-1, 2)
        outline_px = np.abs(np.diff(corners, axis=0, append=corners[:1])).sum()
        # `not <=` refuses NaN too.
        if not max(outline_px, np.abs(corners).max()) <= _LONGEST_OUTLINE_PX:
            raise DataFormatError(
                path,
                f"{where}: a polygon whose outline is longer or farther away than {_LONGEST_OUTLINE_PX:g} pixels",
                cure="give finite corners (x, y) in pixels of the image",
            )
    merged: bytes = pycocotools.mask.merge(pycocotools.mask.frPyObjects(polygons, *size_hw))["counts"]
    return merged


def _run_lengths(data: bytes) -> list[int]:
    """Runs of COCO's compressed counts: little-endian groups of five bits, each run after the third a difference."""
    runs: list[int] = []
    value, shift = 0, 0
    for byte in data:
        group = byte - 48
        if not 0 <= group < 64:
            raise ValueError(f"letter {chr(byte)!r} is not part of the encoding")
        value |= (group & 31) << shift
        shift += 5
        if shift > 5 * _MOST_GROUPS:
            raise ValueError("a number of more than 32 bits")
        if not group & 32:
            if group & 16:
                value -= 1 << shift
            runs.append(value + (runs[-2] if len(runs) > 2 else 0))
            value, shift = 0, 0
    if shift:
        raise ValueError("text ends inside a number")
    return runs


def _is_polygon(polygon: Any) -> bool:
    return isinstance(polygon, list) and all(map(_is_number, polygon))


def _is_number(value: Any) -> bool:
    return type(value) in (int, float)
