"""docs/inspect.md: its pictures are there, its files are those that are written."""

from __future__ import annotations

import re
from dataclasses import fields
from pathlib import Path

from directshape_torch.cli.inspect import _FIGURES
from directshape_torch.visualize.refinement_trace import RefinementTrace

DOCS = Path(__file__).parents[2] / "docs"
TEXT = (DOCS / "inspect.md").read_text(encoding="utf-8")


def test_pictures_exist_and_are_small() -> None:
    names = re.findall(r"\]\((images/[^)]+)\)", TEXT)
    assert len(names) >= 4
    for name in names:
        assert (DOCS / name).stat().st_size < 400_000, name


def test_the_table_lists_every_file() -> None:
    listed = set(re.findall(r"^\| `([\w.]+)` \|", TEXT, re.MULTILINE))
    assert listed == {*_FIGURES, "drift.png"}


def test_the_python_names_exist() -> None:
    known = {f.name for f in fields(RefinementTrace)} | {"T_cam_obj", "codes"}
    assert set(re.findall(r"^trace\.(\w+)", TEXT, re.MULTILINE)) <= known
