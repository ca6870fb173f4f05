"""`timestamps.txt` of KITTI's raw recordings: one date and time a frame, with nanoseconds."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

from directshape_torch.errors import DataFormatError
from directshape_torch.files.text_files import Line, read_lines


def read_timestamps(path: Path) -> list[float]:
    """Seconds since 1970 of each line `2011-09-26 13:02:25.964389445`.

    Raises:
        DataFormatError: a line is no date and time.
    """
    return [_seconds(path, line) for line in read_lines(path)]


def _seconds(path: Path, line: Line) -> float:
    whole, _, fraction = line.text.partition(".")
    try:
        seconds = datetime.strptime(whole, "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC).timestamp()
        return seconds + (float(f"0.{fraction}") if fraction else 0.0)
    except ValueError as error:
        cure = "write YYYY-MM-DD HH:MM:SS.fraction"
        raise DataFormatError(path, f"no time ({error})", line_number=line.number, line=line.text, cure=cure) from error
