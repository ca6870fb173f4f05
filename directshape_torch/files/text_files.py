"""Lines of text files with their numbers, so that every complaint can name the line."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from directshape_torch.files.read_files import read_text


@dataclass(frozen=True)
class Line:
    """One line: its number from 1, its text without outer white space, and all of it but the newline."""

    number: int
    text: str
    raw: str


def read_lines(path: Path | str) -> list[Line]:
    """The lines of a text file that are not blank.

    Raises:
        DataFormatError: the file cannot be read or is not UTF-8 text.
    """
    lines = (Line(number, raw.strip(), raw) for number, raw in enumerate(read_text(path).split("\n"), start=1))
    return [line for line in lines if line.text]
