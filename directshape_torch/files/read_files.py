"""This module opens files that a user names: regular files of limited size, with errors that name file and line.

Files may be hostile, so sizes and numbers are checked before a decoder allocates memory for them, and nothing is
unpickled.
"""

from __future__ import annotations

import codecs
import json
import math
import os
import re
import stat
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, wraps
from pathlib import Path, PurePath
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from directshape_torch.errors import DataFormatError, shown

MOST_BYTES = 2**29
"""This is the limit for one file, and for its unpacked content."""

# A numbered line of one letter takes two hundred bytes.
_MOST_TEXT_BYTES = 2**24
# Parsed JSON takes about twenty times its size.
_MOST_JSON_BYTES = 2**28
_MOST_DIGITS = 18
# UTF-32 is checked first, because one of its marks begins with a mark of UTF-16.
_MARKS = {
    **dict.fromkeys((codecs.BOM_UTF32_LE, codecs.BOM_UTF32_BE), "utf-32"),
    **dict.fromkeys((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE), "utf-16"),
}
# Lines end as on Unix, on Windows (where \r stays in the line, so that lines are copied unchanged) or on old Macs.
_LINE_END = re.compile(r"\n|\r(?!\n)")
# File systems allow 255 bytes; the rest is for endings and for the names of temporary files.
_MOST_NAME_BYTES = 200
_T = TypeVar("_T")


def is_frame_id(frame_id: object) -> bool:
    """Whether a frame's name can be used in file names and is not a path.

    Examples:
        >>> is_frame_id("000107"), is_frame_id("/etc/passwd"), is_frame_id("..")
        (True, False, False)
    """
    return (
        isinstance(frame_id, str)
        and frame_id.isprintable()
        and len(frame_id.encode()) <= _MOST_NAME_BYTES
        and "\\" not in frame_id
        and frame_id not in ("", "..")
        and frame_id == PurePath(frame_id).name
    )


def read_bytes(path: Path | str, most: int = MOST_BYTES, cure: str = "check the path") -> bytes:
    """The content of a regular file of at most `most` bytes; links are followed.

    Raises:
        DataFormatError: the file is missing, unreadable, a folder, a pipe, a device, or too large; the error has the
            cure.

    Examples:
        >>> read_bytes("/dev/zero")
        Traceback (most recent call last):
        ...
        directshape_torch.errors.DataFormatError: /dev/zero: is no regular file; check the path
    """
    if not isinstance(path, (str, os.PathLike)):  # Python would accept the number of an open file
        raise DataFormatError(shown(path), "is no path", cure=cure)
    try:
        with open(path, "rb", opener=_open_at_once) as file:
            state = os.fstat(file.fileno())
            if not stat.S_ISREG(state.st_mode):
                raise DataFormatError(path, "is no regular file", cure=cure)
            if state.st_size > most:
                raise DataFormatError(path, f"has {state.st_size} bytes, at most {most} are read")
            return file.read()
    except OSError as error:
        raise DataFormatError(path, f"cannot be read ({error.strerror})", cure=cure) from error
    except ValueError as error:
        if isinstance(error, DataFormatError):
            raise
        # The path has a NUL, or characters that file systems do not accept.
        raise DataFormatError(repr(str(path)), f"is no path ({error})", cure=cure) from error


def _open_at_once(path: str, flags: int) -> int:
    """Open a file without blocking, as a pipe would until a process writes to it."""
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))


def read_text(path: Path | str, most: int = _MOST_TEXT_BYTES, cure: str = "check the path") -> str:
    """The content of a text file in UTF-8, or in UTF-16 or UTF-32 if it begins with their mark.

    PowerShell and Excel write such a mark, which is removed. Errors are those of `read_bytes`, and a `DataFormatError`
    for other content.
    """
    content = read_bytes(path, most, cure)
    encoding = next((encoding for mark, encoding in _MARKS.items() if content.startswith(mark)), "utf-8-sig")
    try:
        return content.decode(encoding)
    except UnicodeDecodeError as error:
        problem = f"is not {error.encoding.upper()} text ({error.reason} at byte {error.start})"
        raise DataFormatError(path, problem, cure="save it as UTF-8") from error


def remembered(read: Callable[[Path], _T]) -> Callable[[Path | str], _T]:
    """A version of `read` with a cache, which is valid while size and time of change of the file stay the same.

    It is for files that serve many frames. Callers must not modify the result.
    """

    # The state of the file is used only as a key of the cache.
    @lru_cache(maxsize=256)
    def in_state(path: Path, _size_bytes: int, _changed_ns: int) -> _T:
        return read(path)

    @wraps(read)
    def of_path(path: Path | str) -> _T:
        path = Path(path)
        if not path.is_file():
            return read(path)
        state = path.stat()
        return in_state(path, state.st_size, state.st_mtime_ns)

    return of_path


@dataclass(frozen=True)
class Line:
    """A `Line` has its number from 1, its text without outer white space, and the raw text without the newline."""

    number: int
    text: str
    raw: str

    def error(self, path: Path | str, problem: str, cure: str = "") -> DataFormatError:
        """An error about the line that names it."""
        return DataFormatError(path, problem, line_number=self.number, line=self.text, cure=cure)


def read_lines(path: Path | str) -> list[Line]:
    """The lines of a text file that are not blank; errors are those of `read_text`."""
    lines = (Line(number, raw.strip(), raw) for number, raw in enumerate(_LINE_END.split(read_text(path)), start=1))
    return [line for line in lines if line.text]


def finite_numbers(
    path: Path | str, line: Line, count: int, words: Sequence[str] | None = None, cure: str = ""
) -> NDArray[np.float64]:
    """The numbers (count,) of a line, or of its last words.

    Raises:
        DataFormatError: the line has another content or number of words; the error names file and line.

    Examples:
        >>> finite_numbers("calib.txt", Line(3, "1 2.5", "1 2.5"), 2)
        array([1. , 2.5])
    """
    columns = line.text.split()
    words = columns if words is None else words
    if len(words) != count:
        raise line.error(path, f"expected {count} finite numbers, got {len(words)}", cure)
    values = [_finite(word) for word in words]
    if None in values:
        place = values.index(None)
        column = len(columns) - count + place + 1
        raise line.error(path, f"column {column} is {words[place]!r}, not a finite number", cure)
    return np.array(values, dtype=np.float64)


def _finite(word: str) -> float | None:
    try:
        return float(word) if math.isfinite(float(word)) else None
    except ValueError:
        return None


def read_json(path: Path | str, cure: str = "") -> Any:
    """The value in a JSON file; errors are those of `read_bytes` and `parse_json`."""
    return parse_json(path, read_bytes(path, _MOST_JSON_BYTES), cure)


def parse_json(path: Path | str, text: str | bytes, cure: str = "", problem: str = "is not valid JSON") -> Any:
    """The value of a JSON text from the file `path`.

    Raises:
        DataFormatError: the text is not JSON, is nested too deeply, or has a number that is not finite or has more than
            18 digits before its point; the error has the problem and the cure.

    Examples:
        >>> parse_json("a.json", "[1, 1e999]")
        Traceback (most recent call last):
        ...
        directshape_torch.errors.DataFormatError: a.json: is not valid JSON (the number 1e999 is out of range)
    """
    try:
        return json.loads(text, parse_int=_whole, parse_float=_decimal, parse_constant=_decimal)
    except (ValueError, RecursionError) as error:
        raise DataFormatError(path, f"{problem} ({error})", cure=cure) from error


def _whole(text: str) -> int:
    if len(text) > _MOST_DIGITS:
        raise ValueError(f"a whole number of {len(text)} digits")
    return int(text)


def _decimal(text: str) -> float:
    number = float(text)
    if not abs(number) < float("inf"):
        raise ValueError(f"the number {text} is out of range")
    return number
