"""Every page begins with its question, its links lead somewhere, and its commands and Python are accepted."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
import shlex
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import yaml

from directshape_torch.cli.main import make_parser
from directshape_torch.io.config_files import load_config

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = sorted(path for path in DOCS.rglob("*.md") if path.name not in ("conventions.md", "changelog.md"))
WITH_CODE = [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]
NAMED = [pytest.param(path, id=str(path.relative_to(ROOT))) for path in (ROOT / "README.md", *PAGES)]


def anchors(text: str) -> set[str]:
    prose = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    headings = re.findall(r"^#+ (.+)$", prose, re.MULTILINE)
    return {re.sub(r"[\s-]+", "-", re.sub(r"[^\w\s-]", "", heading).strip().lower()) for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(DOCS)))
def test_the_first_line_is_the_question_that_the_page_answers(page: Path) -> None:
    title, empty, question = page.read_text(encoding="utf-8").splitlines()[:3]
    assert title.startswith("# ")
    assert not empty
    assert re.fullmatch(r"\*[^*]+\?\*", question), question


@pytest.mark.parametrize("page", NAMED)
def test_every_link_leads_to_a_file_and_its_heading(page: Path) -> None:
    for link in re.findall(r"\]\((?!https?://)([^)]+)\)", page.read_text(encoding="utf-8")):
        name, _, anchor = link.partition("#")
        target = page.parent / name if name else page
        assert target.is_file(), link
        assert not anchor or anchor in anchors(target.read_text(encoding="utf-8")), link


def commands(page: Path) -> list[str]:
    """Arguments of the fully written `directshape` commands in the shell blocks of a page."""
    blocks = re.findall(r"```bash\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    lines = [line for block in blocks for line in re.sub(r"\\\n", " ", block).splitlines()]
    found = [line.removeprefix("directshape ") for line in lines if line.startswith("directshape ")]
    return [line for line in found if " .. " not in line and " ..." not in line]


COMMANDS = [
    pytest.param(command, id=f"{page.stem}-{n}") for page in WITH_CODE for n, command in enumerate(commands(page))
]


def test_commands_are_found() -> None:
    assert len(COMMANDS) > 30


@pytest.mark.parametrize("command", COMMANDS)
def test_each_command_is_understood(command: str) -> None:
    args = make_parser().parse_args(shlex.split(command, comments=True))
    load_config(None, getattr(args, "set", None) or [])


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


CALLS = [
    pytest.param(call, called, id=f"{page.stem}-{n}")
    for page in WITH_CODE
    for n, (call, called) in enumerate(calls_of(page))
]


def test_calls_are_found() -> None:
    assert len(CALLS) > 20


@pytest.mark.parametrize(("call", "called"), CALLS)
def test_each_call_has_arguments_that_are_taken(call: ast.Call, called: Callable[..., object]) -> None:
    named = {each.arg: each for each in call.keywords if each.arg is not None}
    inspect.signature(called).bind(*call.args, **named)


def test_the_citation_has_the_version_of_the_package() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    assert citation["version"] == tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["version"]
