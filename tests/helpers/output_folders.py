"""This module lists the files of a run in its output folder."""

from __future__ import annotations

from pathlib import Path


def result_files(folder: Path) -> dict[str, bytes]:
    """All files by name, except those about the run itself."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != "timings.json"
    }
