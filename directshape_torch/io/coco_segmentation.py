"""Decode COCO segmentations: run lengths (column-major) as text, bytes or list, and polygons."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from directshape_torch.errors import DataFormatError, shown
from directshape_torch.io.instance_masks import check_size

# More than any outline has; rasterising takes memory for each pixel of it, wherever it lies.
_LONGEST_OUTLINE_PX = 1e6
# Five bits each, of runs that fit into 32.
_MOST_GROUPS = 7


def decode_segmentation(path: Path, where: str, segmentation: Any, size_hw: tuple[int, int]) -> NDArray[np.bool_]:
    """A binary mask from the `segmentation` of a COCO result.

    Args:
        path, where: the file and the entry's place in it, named in errors.
        segmentation: RLE `{"size": [H, W], "counts": str | bytes | list}`, or a list of polygons
            `[x0, y0, x1, y1, ..]`.
        size_hw: size of the image.

    Returns:
        (H, W) bool.

    Raises:
        MaskSizeError: run lengths of another size than the image.
        DataFormatError: neither form, runs that do not add up to the size, or polygons far beyond the image.

    Examples:
        >>> rle = {"size": [2, 3], "counts": [2, 3, 1]}  # down the columns: 2 off, 3 on, 1 off
        >>> decode_segmentation(Path("masks.json"), "entry 0", rle, (2, 3)).astype(int).tolist()
        [[0, 1, 1], [0, 1, 0]]
    """
    if isinstance(segmentation, Mapping) and "counts" in segmentation and "size" in segmentation:
        size = segmentation["size"]
        if not isinstance(size, (list, tuple)) or len(size) != 2 or not all(map(_is_whole, size)):
            raise DataFormatError(path, f"{where}: bad run lengths ('size' is {shown(size)}, expected [height, width])")
        check_size(path, f"{where}: the mask", size, size_hw)
        return _from_runs(path, where, segmentation["counts"], size_hw)
    if isinstance(segmentation, list) and segmentation and _are_polygons(segmentation):
        return _from_runs(path, where, _outlined(path, where, segmentation, size_hw), size_hw)
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
    _check_total(path, where, sum(runs), height, width)
    is_on = np.arange(len(runs)) % 2 == 1
    return np.ascontiguousarray(np.repeat(is_on, runs).reshape(width, height).T)


def _runs(counts: Any) -> Sequence[int]:
    """Run lengths as numbers of at least 0.

    Raises:
        ValueError: they are something else.
    """
    if isinstance(counts, (str, bytes)):
        runs = _run_lengths(counts.encode("ascii") if isinstance(counts, str) else counts)
    elif isinstance(counts, list) and all(map(_is_whole, counts)):
        runs = counts
    else:
        raise ValueError(f"'counts' is {shown(counts)}, expected text or a list of whole numbers")
    if min(runs, default=0) < 0:
        raise ValueError(f"a run of {min(runs)} pixels")
    return runs


def _outlined(path: Path, where: str, polygons: Sequence[Sequence[float]], size_hw: tuple[int, int]) -> bytes:
    """The run lengths of what polygons cover."""
    import pycocotools.mask

    for polygon in polygons:
        corners = np.array(polygon, dtype=np.float64).reshape(-1, 2)
        outline_px = np.abs(np.diff(corners, axis=0, append=corners[:1])).sum()
        # `not <=`, so that NaN is refused too.
        if not max(outline_px, np.abs(corners).max()) <= _LONGEST_OUTLINE_PX:
            raise DataFormatError(
                path,
                f"{where}: a polygon whose outline is longer or farther away than {_LONGEST_OUTLINE_PX:g} pixels",
                cure="give finite corners (x, y) in pixels of the image",
            )
    merged: bytes = pycocotools.mask.merge(pycocotools.mask.frPyObjects(polygons, *size_hw))["counts"]
    return merged


def _check_total(path: Path, where: str, total: int, height: int, width: int) -> None:
    if total != height * width:
        raise DataFormatError(
            path,
            f"{where}: run lengths cover {total} pixels, expected {height} x {width} = {height * width}",
            cure="the file is damaged, or 'size' is not [height, width]",
        )


def _run_lengths(data: bytes) -> list[int]:
    """Runs of COCO's compressed counts: little-endian groups of five bits, each run after the third a difference.

    Raises:
        ValueError: the text ends inside a number or has a letter outside the alphabet.
    """
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


def _are_polygons(segmentation: list[Any]) -> bool:
    return all(
        isinstance(polygon, list) and len(polygon) >= 6 and len(polygon) % 2 == 0 and all(map(_is_number, polygon))
        for polygon in segmentation
    )


def _is_number(value: Any) -> bool:
    return type(value) in (int, float)


def _is_whole(value: Any) -> bool:
    return type(value) is int
