"""This module opens files that a user names: regular files of limited size, with errors that name the file.

Files may be hostile, so sizes and numbers are checked before a decoder allocates memory for them, and nothing is
unpickled.
"""

from __future__ import annotations

import json
import os
import stat
from pathlib import Path
from typing import Any

from directshape_torch.errors import DataFormatError, shown

MOST_BYTES = 2**29
"""This is the limit for one file, and for its unpacked content."""

# Parsed JSON takes about twenty times its size.
_MOST_JSON_BYTES = 2**28
_MOST_DIGITS = 18


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
