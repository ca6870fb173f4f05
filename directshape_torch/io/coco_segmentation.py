"""Decode COCO segmentations: run lengths (column-major) as text, bytes or list, and polygons."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from directshape_torch.errors import DataFormatError


def decode_segmentation(path: Path, index: int, segmentation: Any, size_hw: tuple[int, int]) -> NDArray[np.bool_]:
    """A binary mask from the `segmentation` of a COCO result.

    Args:
        path, index: the file and the entry's place in it, named in errors.
        segmentation: RLE `{"size": [H, W], "counts": str | bytes | list}`, or a list of polygons
            `[x0, y0, x1, y1, ..]`.
        size_hw: size of the image, which polygons do not tell.

    Returns:
        (H, W) bool; run-length masks in the size that they state.

    Raises:
        DataFormatError: neither form, or runs that do not add up to the size.

    Example:
        >>> rle = {"size": [2, 3], "counts": [2, 3, 1]}  # down the columns: 2 off, 3 on, 1 off
        >>> decode_segmentation(Path("masks.json"), 0, rle, (2, 3)).astype(int).tolist()
        [[0, 1, 1], [0, 1, 0]]
    """
    import pycocotools.mask

    if isinstance(segmentation, Mapping) and "counts" in segmentation and "size" in segmentation:
        rle = _compressed(path, index, segmentation)
    elif isinstance(segmentation, list) and segmentation and _are_polygons(segmentation):
        rle = pycocotools.mask.merge(pycocotools.mask.frPyObjects(segmentation, size_hw[0], size_hw[1]))
    else:
        raise DataFormatError(
            path,
            f"entry {index}: 'segmentation' is neither RLE nor a list of polygons",
            cure='write {"size": [H, W], "counts": ..}',
        )
    try:
        with warnings.catch_warnings():
            # pycocotools 2.0.11 does not yet know numpy 2's `copy` keyword; its result is right all the same.
            warnings.simplefilter("ignore", DeprecationWarning)
            return np.asarray(pycocotools.mask.decode(rle), dtype=np.bool_)
    except (ValueError, TypeError) as error:
        raise DataFormatError(path, f"entry {index}: run lengths cannot be decoded ({error})") from error


def _compressed(path: Path, index: int, rle: Mapping[str, Any]) -> dict[str, Any]:
    """The compressed form of an RLE, its runs checked: the decoder fills what too few runs leave with stray memory."""
    import pycocotools.mask

    try:
        height, width = (int(n) for n in rle["size"])
        counts = rle["counts"]
        if isinstance(counts, list):
            _check_total(path, index, sum(counts), height, width)
            compressed: dict[str, Any] = pycocotools.mask.frPyObjects(dict(rle), height, width)
            return compressed
        data = counts.encode("ascii") if isinstance(counts, str) else bytes(counts)
        _check_total(path, index, sum(_run_lengths(data)), height, width)
    except (TypeError, ValueError, UnicodeEncodeError) as error:
        if isinstance(error, DataFormatError):
            raise
        raise DataFormatError(path, f"entry {index}: bad run lengths ({error})") from error
    return {"size": [height, width], "counts": data}


def _check_total(path: Path, index: int, total: int, height: int, width: int) -> None:
    if total != height * width:
        raise DataFormatError(
            path,
            f"entry {index}: run lengths cover {total} pixels, expected {height} x {width} = {height * width}",
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
        if not group & 32:
            if group & 16:
                value -= 1 << shift
            runs.append(value + (runs[-2] if len(runs) > 2 else 0))
            value, shift = 0, 0
    if shift:
        raise ValueError("text ends inside a number")
    return runs


def _are_polygons(segmentation: list[Any]) -> bool:
    return all(isinstance(polygon, list) and len(polygon) >= 6 and len(polygon) % 2 == 0 for polygon in segmentation)
