"""This module reads texts in any form of Unicode, and their lines, whose errors name file and line."""

from __future__ import annotations

import codecs
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from directshape_torch.errors import DataFormatError
from directshape_torch.files.read_files import read_bytes

# A numbered line of one letter takes two hundred bytes.
_MOST_TEXT_BYTES = 2**24
# UTF-32 is checked first, because one of its marks begins with a mark of UTF-16.
_MARKS = {
    **dict.fromkeys((codecs.BOM_UTF32_LE, codecs.BOM_UTF32_BE), "utf-32"),
    **dict.fromkeys((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE), "utf-16"),
}
# Lines end as on Unix, on Windows (where \r stays in the line, so that lines are copied unchanged) or on old Macs.
_LINE_END = re.compile(r"\n|\r(?!\n)")


def read_text(path: Path | str, most: int = _MOST_TEXT_BYTES) -> str:
    """The content of a text file in UTF-8, or in UTF-16 or UTF-32 if it begins with their mark.

    PowerShell and Excel write such a mark, which is removed. Errors are those of `read_bytes`, and a `DataFormatError`
    for other content.
    """
    content = read_bytes(path, most)
    encoding = next((encoding for mark, encoding in _MARKS.items() if content.startswith(mark)), "utf-8-sig")
    try:
        return content.decode(encoding)
    except UnicodeDecodeError as error:
        problem = f"is not {error.encoding.upper()} text ({error.reason} at byte {error.start})"
        raise DataFormatError(path, problem, cure="save it as UTF-8") from error


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
