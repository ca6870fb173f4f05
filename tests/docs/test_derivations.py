"""The derivations name what the code names, and say where the paper is inexact."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = sorted((ROOT / "docs" / "derivations").glob("[!R]*.md"))
OVERVIEW = (ROOT / "docs" / "derivations" / "README.md").read_text(encoding="utf-8")
CODE = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "directshape_torch").rglob("*.py"))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_symbols_are_names_of_the_code(page: Path) -> None:
    table = page.read_text(encoding="utf-8").partition("| ours |")[2].partition("\n\n")[0]
    cells = [name for line in table.splitlines() for name in re.findall("`([^`]+)`", line.split("|")[1])]
    names = [name for cell in cells for name in re.findall(r"[^\W\d]\w+", cell)]
    assert names
    assert not [name for name in names if not re.search(rf"\b{name}\b", CODE)]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_page_says_where_the_paper_is_inexact_and_is_in_the_overview(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert f"({page.name})" in OVERVIEW
    rows = [line for line in text.partition("## Where the paper's text is inexact")[2].splitlines() if line[:2] == "| "]
    assert rows[1:]


def test_every_named_file_of_the_overview_exists() -> None:
    for name in re.findall(r"`((?:(?:geometry|terms|shape|image)/)?\w+\.py)`", OVERVIEW):
        assert (ROOT / "directshape_torch" / name).is_file(), name
