"""The derivations name tests that exist, and say where the paper is inexact."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = sorted((ROOT / "docs" / "derivations").glob("[!R]*.md"))
OVERVIEW = (ROOT / "docs" / "derivations" / "README.md").read_text(encoding="utf-8")
CODE = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "directshape_torch").rglob("*.py"))
NAMED_TEST = re.compile(r"tests/[\w/]+\.py(?:::\w+)?")


def functions_of(path: Path) -> set[str]:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_symbols_are_names_of_the_code(page: Path) -> None:
    table = page.read_text(encoding="utf-8").partition("| ours |")[2].partition("\n\n")[0]
    cells = [name for line in table.splitlines() for name in re.findall("`([^`]+)`", line.split("|")[1])]
    names = [name for cell in cells for name in re.findall(r"[^\W\d]\w+", cell)]
    assert names
    assert not [name for name in names if not re.search(rf"\b{name}\b", CODE)]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_page_has_its_symbols_and_names_tests_that_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert "| ours | the paper's | meaning |" in text
    assert f"({page.name})" in OVERVIEW
    names = NAMED_TEST.findall(text)
    assert names
    for name in names:
        path, separator, function = name.partition("::")
        assert separator, f"{name}: name the test, not only its file"
        assert (ROOT / path).is_file(), name
        assert function.startswith("test_"), name
        assert function in functions_of(ROOT / path), name
    # Where the paper is inexact a test says so.
    rows = [line for line in text.partition("## Where the paper's text is inexact")[2].splitlines() if line[:2] == "| "]
    assert rows[1:]
    for row in rows[1:]:
        assert NAMED_TEST.search(row.split("|")[-2]), row


def test_every_named_file_of_the_overview_exists() -> None:
    for name in re.findall(r"`((?:(?:geometry|terms|shape|image)/)?\w+\.py)`", OVERVIEW):
        assert (ROOT / "directshape_torch" / name).is_file(), name
