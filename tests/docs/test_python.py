"""The Python in README and docs calls existing functions with arguments that they accept."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def calls_of(page: Path) -> Iterator[tuple[ast.Call, Callable[..., object]]]:
    """Fully written calls of objects that a page imports from the package."""
    imported: dict[str, object] = {}
    for code in re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL):
        if "--8<--" in code:
            continue
        for node in ast.walk(tree := ast.parse(code.replace(": ...", ": pass"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("directshape_torch"):
                module = importlib.import_module(node.module or "")
                imported |= {each.asname or each.name: getattr(module, each.name) for each in node.names}
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and not any(is_left_out(each) for each in node.args):
                owner, *names = ast.unparse(node.func).split(".")
                called = imported.get(owner)
                for name in names:
                    called = getattr(called, name, None)
                if callable(called):
                    yield node, called


def is_left_out(argument: ast.expr) -> bool:
    return isinstance(argument, ast.Starred) or (isinstance(argument, ast.Constant) and argument.value is ...)


ALL = [
    pytest.param(call, called, id=f"{page.stem}-{n}")
    for page in PAGES
    for n, (call, called) in enumerate(calls_of(page))
]


def test_calls_are_found() -> None:
    assert len(ALL) > 20


@pytest.mark.parametrize(("call", "called"), ALL)
def test_each_call_has_arguments_that_are_taken(call: ast.Call, called: Callable[..., object]) -> None:
    named = {each.arg: each for each in call.keywords if each.arg is not None}
    inspect.signature(called).bind(*call.args, **named)
