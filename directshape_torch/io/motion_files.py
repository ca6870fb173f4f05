"""This module reads text files with the time and camera pose of each frame of a sequence, one line per frame."""

from __future__ import annotations

from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from directshape_torch.errors import DataFormatError
from directshape_torch.files.find_files import remembered
from directshape_torch.files.text_files import Line, finite_numbers, read_lines
from directshape_torch.numerics.checks import is_no_rotation


@remembered
def read_times(path: Path | str) -> NDArray[np.float64]:
    """Times (N,) in seconds since the first line.

    The file is `times.txt` of KITTI's odometry benchmark (seconds), or `timestamps.txt` of its raw recordings (dates
    with times of day).
    """
    lines = read_lines(path)
    seconds: NDArray[np.float64] = np.array([_seconds(path, line) for line in lines], dtype=np.float64)
    for line, (before, here) in zip(lines[1:], pairwise(seconds), strict=True):
        if not before < here:
            raise line.error(path, "time does not go on", "write one time a frame, in their order")
    return seconds - seconds[:1]


@remembered
def read_poses(path: Path | str) -> NDArray[np.float64]:
    """Poses (N, 4, 4) of camera 0, the frame `ref` of boxes, relative to the first line.

    Lines are rows of a matrix (3, 4), as in KITTI's odometry benchmark. Relative poses have small numbers, which suit
    float32.
    """
    lines = read_lines(path)
    T_world_ref = np.tile(np.eye(4), (len(lines), 1, 1))
    for number, line in enumerate(lines):
        T_world_ref[number, :3] = finite_numbers(path, line, 12).reshape(3, 4)
        if is_no_rotation(torch.from_numpy(T_world_ref[number, None])).any():
            raise line.error(path, "its first three columns are no rotation")
    return np.linalg.inv(T_world_ref[:1]) @ T_world_ref


def of_line(path: Path, values: NDArray[np.float64], number: int) -> NDArray[np.float64]:
    """The value in a file for a frame number, from 0."""
    if number >= len(values):
        problem = f"has {len(values)} lines and none for frame {number}"
        raise DataFormatError(path, problem, cure="write a line for each frame of the sequence, from frame 0 on")
    return values[number]  # type: ignore[no-any-return]


def _seconds(path: Path | str, line: Line) -> float:
    try:
        # Python parses microseconds, but the recordings have nanoseconds.
        seconds = (
            datetime.fromisoformat(line.text[:26]).replace(tzinfo=UTC).timestamp()
            if ":" in line.text
            else float(line.text)
        )
    except (ValueError, OverflowError) as error:
        problem = f"expected seconds or a date and time ({error})"
        raise line.error(path, problem) from error
    if not np.isfinite(seconds):
        raise line.error(path, "expected finite seconds")
    return seconds
