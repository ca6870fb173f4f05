"""This script writes `configs/default.yaml` from `directshape_torch/config.py`.

    python scripts/write_default_config.py

Each key has its meaning, type, unit, limits and default. Run the script after changing a setting; a test compares the
two.
"""

from __future__ import annotations

import argparse
import dataclasses
import textwrap
import typing
from pathlib import Path
from typing import Any

import yaml

from directshape_torch.config import RefinerConfig, Settings, limits_in_words
from directshape_torch.io.config_files import config_to_mapping

TARGET = Path(__file__).parent.parent / "directshape_torch" / "assets" / "configs" / "default.yaml"
_UNITS = {
    "_m": "metres",
    "_px": "pixels",
    "_deg": "degrees",
    "_grey_levels": "grey levels",
}
_UNBROKEN = "\N{NO-BREAK SPACE}"
HEADER = """\
# The default settings: the best we know. They are also what the program uses without --config.
# Written by scripts/write_default_config.py from directshape_torch/config.py; a file may hold any subset of the keys.
# Brackets: type, unit and what is allowed. Lengths are in metres and image sizes in pixels of full resolution, as the
# names say; what has no unit is a factor, a share or a count.
"""


def main() -> None:
    """Write the file."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    TARGET.write_text(default_yaml(), encoding="utf-8")


def default_yaml() -> str:
    """The content of the file."""
    config = RefinerConfig()
    return HEADER + "".join(f"\n{_section(field, getattr(config, field.name))}" for field in dataclasses.fields(config))


def _section(field: dataclasses.Field[Any], part: Any) -> str:
    if isinstance(part, Settings):
        return _title(part, field.name) + "".join(
            _setting(type(part), f, getattr(part, f.name), "  ") for f in dataclasses.fields(part)
        )
    if isinstance(part, tuple):
        keys = "".join(
            _comment(f"{f.name}: {_description(type(part[0]), f)}", "  ") for f in dataclasses.fields(part[0])
        )
        return _title(part[0], field.name) + keys + "".join(f"  - {_entry(stage)}" for stage in part)
    return _setting(RefinerConfig, field, part, "")


def _title(part: Settings, name: str) -> str:
    return _comment((type(part).__doc__ or "").splitlines()[0], "") + f"{name}:\n"


def _entry(stage: Settings) -> str:
    return yaml.safe_dump(config_to_mapping(stage), default_flow_style=True, width=200, sort_keys=False)


def _setting(group: type[Settings], field: dataclasses.Field[Any], value: Any, indent: str) -> str:
    in_line = None if isinstance(value, tuple) else False
    line = yaml.safe_dump({field.name: config_to_mapping(value)}, default_flow_style=in_line)
    return _comment(_description(group, field), indent) + indent + line


def _description(group: type[Settings], field: dataclasses.Field[Any]) -> str:
    # Brackets stay on one line.
    allowed = [_kind(group.types()[field.name]) + _unit(field.name), limits_in_words(field.metadata["limits"])]
    return f"{field.metadata['description']} [{', '.join(filter(None, allowed)).replace(' ', _UNBROKEN)}]"


def _kind(hint: Any) -> str:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Literal:
        return "one of " + " | ".join(arguments)
    if origin is tuple:
        return f"list of {len(arguments)} numbers"
    kinds: dict[Any, str] = {float: "number", int: "whole number", bool: "true or false"}
    return kinds[hint]


def _unit(name: str) -> str:
    return next((f" in {unit}" for ending, unit in _UNITS.items() if name.endswith(ending)), "")


def _comment(text: str, indent: str) -> str:
    prefix = f"{indent}# "
    return textwrap.fill(text, 118, initial_indent=prefix, subsequent_indent=prefix).replace(_UNBROKEN, " ") + "\n"


if __name__ == "__main__":
    main()
