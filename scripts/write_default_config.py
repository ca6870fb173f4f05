"""Writes `configs/default.yaml` from the defaults in `directshape_torch/config.py`, each key with its description.

    python scripts/write_default_config.py

Run it after changing a default; a test compares the two.
"""

from __future__ import annotations

import argparse
import dataclasses
import re
import textwrap
from pathlib import Path
from typing import Any

import yaml

from directshape_torch.config import RefinerConfig
from directshape_torch.config_files import config_to_mapping

TARGET = Path(__file__).parent.parent / "directshape_torch" / "assets" / "configs" / "default.yaml"
HEADER = """\
# The default settings: the best we know. They are also what the program uses without --config.
# Written by scripts/write_default_config.py from directshape_torch/config.py; a file may hold any subset of the keys.
"""


def main() -> None:
    """Write the file."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    TARGET.write_text(default_yaml(), encoding="utf-8")


def default_yaml() -> str:
    """The content of the file."""
    config = RefinerConfig()
    sections = [_section(field.name, getattr(config, field.name)) for field in dataclasses.fields(config)]
    return HEADER + "".join(f"\n{section}" for section in sections)


def _section(name: str, part: Any) -> str:
    if isinstance(part, str):
        return _comment(_descriptions(RefinerConfig)[name], "") + yaml.safe_dump({name: part})
    if not dataclasses.is_dataclass(part):
        stages = "".join(
            f"  - {yaml.safe_dump(config_to_mapping(s), default_flow_style=True, width=200)}" for s in part
        )
        described = _descriptions(type(part[0])).items()
        return _comment(_first_line(type(part[0])), "") + f"{name}:\n" + _comments(dict(described)) + stages
    descriptions = _descriptions(type(part))
    lines = [_comment(_first_line(type(part)), "") + f"{name}:\n"]
    for field in dataclasses.fields(part):
        lines.append(_comment(descriptions.pop(field.name, ""), "  "))
        value = config_to_mapping(getattr(part, field.name))
        lines.append(
            "  " + yaml.safe_dump({field.name: value}, default_flow_style=None if isinstance(value, list) else False)
        )
    return "".join(lines)


def _comments(descriptions: dict[str, str]) -> str:
    return "".join(_comment(f"{name}: {text}", "  ") for name, text in descriptions.items())


def _comment(text: str, indent: str) -> str:
    prefix = f"{indent}# "
    return textwrap.fill(text, 118, initial_indent=prefix, subsequent_indent=prefix) + "\n" if text else ""


def _first_line(cls: type) -> str:
    return (cls.__doc__ or "").strip().splitlines()[0]


def _descriptions(cls: type) -> dict[str, str]:
    """The entries of a docstring's `Attributes:`; those for several names stand at the first."""
    text = (cls.__doc__ or "").partition("Attributes:")[2]
    entries = re.findall(r"^        (\w[\w, ]*): (.*(?:\n            .*)*)", text, flags=re.MULTILINE)
    described = {}
    for names, description in entries:
        first, *others = re.split(r", *", names)
        words = " ".join(description.split())
        described[first] = f"(with {', '.join(others)}) {words}" if others else words
    return described


if __name__ == "__main__":
    main()
