"""The program accepts every command in README and docs, and their settings exist."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from directshape_torch.cli.main import make_parser
from directshape_torch.io.config_files import load_config

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def commands(page: Path) -> list[str]:
    """Arguments of the fully written `directshape` commands in the shell blocks of a page."""
    blocks = re.findall(r"```bash\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    lines = [line for block in blocks for line in re.sub(r"\\\n", " ", block).splitlines()]
    found = [line.removeprefix("directshape ") for line in lines if line.startswith("directshape ")]
    return [line for line in found if " .. " not in line and " ..." not in line]


ALL = [pytest.param(command, id=f"{page.stem}-{n}") for page in PAGES for n, command in enumerate(commands(page))]


def test_commands_are_found() -> None:
    assert len(ALL) > 30


@pytest.mark.parametrize("command", ALL)
def test_each_command_is_understood(command: str) -> None:
    args = make_parser().parse_args(shlex.split(command, comments=True))
    load_config(None, getattr(args, "set", None) or [])
