"""This module reads and writes JSON files of rig estimates (docs/file_formats.md)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from directshape_torch.errors import DataFormatError, InputError, shown
from directshape_torch.files.atomic_files import write_json
from directshape_torch.files.read_files import read_json
from directshape_torch.rig.estimate import RigEstimate

# These are the names in the folder of a run.
RIG_FILE, RIG_PICTURE = "rig.json", "rig.png"
RIGS, SCHEMA_VERSION = "directshape rig", 1
_CURE = "make it again with 'directshape calibrate-rig'"


def save_rigs(path: Path | str, rigs: Sequence[RigEstimate]) -> None:
    """Write the estimates of one or several rigs; a reader sees the old file or the new one, never half of it."""
    entries = [{**rig.content(), "says": str(rig)} for rig in rigs]
    write_json(path, {"schema": RIGS, "schema_version": SCHEMA_VERSION, "rigs": entries})


def load_rigs(path: Path | str) -> list[RigEstimate]:
    """The estimates in a file.

    Raises:
        DataFormatError: the file is missing, damaged, or holds no estimates.
    """
    content = read_json(path, _CURE)
    found = (content.get("schema"), content.get("schema_version")) if isinstance(content, dict) else (None, None)
    if found != (RIGS, SCHEMA_VERSION):
        said = f"is no file of rigs (schema {RIGS!r}, version {SCHEMA_VERSION}), got "
        raise DataFormatError(path, said + ", version ".join(map(shown, found)), cure=_CURE)
    try:
        return [RigEstimate.of_content(entry) for entry in content["rigs"]]
    except (KeyError, TypeError, InputError) as error:
        raise DataFormatError(path, f"is damaged ({error.__cause__ or error!r})", cure=_CURE) from error


def known_rigs(name: str) -> list[RigEstimate]:
    """Estimates in the file that `--rig` names; the list is empty for "none" and "auto"."""
    return [] if name in ("none", "auto") else load_rigs(name)
