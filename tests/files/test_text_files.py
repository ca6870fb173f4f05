"""Texts of other programs are read, with a mark of their encoding and with the line ends of any system."""

from __future__ import annotations

from pathlib import Path

import pytest

from directshape_torch.errors import DataFormatError
from directshape_torch.files.read_files import read_json
from directshape_torch.files.text_files import read_lines, read_text

MARKED = ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-32", "utf-32-be"]


def encoded(text: str, encoding: str) -> bytes:
    """The text with the mark that programs write before it."""
    mark = "\ufeff" if encoding in ("utf-16-le", "utf-16-be", "utf-32-be") else ""
    return (mark + text).encode(encoding)


@pytest.mark.parametrize("encoding", MARKED)
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_lines(tmp_path: Path, encoding: str, end: str) -> None:
    path = tmp_path / "a.txt"
    path.write_bytes(encoded(end.join(["Car 1", "", "  Ü 2 ", ""]), encoding))
    assert [(line.number, line.text) for line in read_lines(path)] == [(1, "Car 1"), (3, "Ü 2")]


@pytest.mark.parametrize("encoding", MARKED)
def test_json(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "a.json"
    path.write_bytes(encoded('{"ü": [1]}', encoding))
    assert read_json(path) == {"ü": [1]}


@pytest.mark.parametrize("encoding", MARKED)
def test_a_mark_alone_is_an_empty_text(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "a.txt"
    path.write_bytes(encoded("", encoding))
    assert read_text(path) == ""
    assert read_lines(path) == []


@pytest.mark.parametrize("content", [b"caf\xe9", b"\xff\xfeC\x00a"])
def test_another_encoding_is_named_with_the_cure(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.txt"
    path.write_bytes(content)
    with pytest.raises(DataFormatError, match=r"a\.txt: is not UTF-\S+ text .*; save it as UTF-8"):
        read_text(path)
