"""Lines of text files with their numbers, so that every complaint can name the line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from directshape_torch.errors import DataFormatError
from directshape_torch.files.read_files import read_text


@dataclass(frozen=True)
class Line:
    """One line: its number from 1, its text without outer white space, and all of it but the newline."""

    number: int
    text: str
    raw: str

    def error(self, path: Path | str, problem: str, cure: str = "") -> DataFormatError:
        """A complaint about the line that names it."""
        return DataFormatError(path, problem, line_number=self.number, line=self.text, cure=cure)


def read_lines(path: Path | str) -> list[Line]:
    """The lines of a text file that are not blank.

    Raises:
        DataFormatError: the file cannot be read or is not UTF-8 text.
    """
    lines = (Line(number, raw.strip(), raw) for number, raw in enumerate(read_text(path).split("\n"), start=1))
    return [line for line in lines if line.text]


def finite_numbers(
    path: Path | str, line: Line, count: int, words: Sequence[str] | None = None, cure: str = ""
) -> NDArray[np.float64]:
    """The numbers (count,) of a line, or of some of its words.

    Raises:
        DataFormatError: it holds something else, or not as many; names file and line.

    Examples:
        >>> finite_numbers("calib.txt", Line(3, "1 2.5", "1 2.5"), 2)
        array([1. , 2.5])
    """
    try:
        values = np.array([float(word) for word in (line.text.split() if words is None else words)])
    except ValueError as error:
        raise line.error(path, f"expected {count} numbers ({error})", cure) from error
    if len(values) != count or not np.isfinite(values).all():
        raise line.error(path, f"expected {count} finite numbers, got {len(values)}", cure)
    return values
