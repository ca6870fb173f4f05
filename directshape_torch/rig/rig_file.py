"""This module reads and writes JSON files of rig estimates and of given fields (docs/file_formats.md)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from directshape_torch.errors import DataFormatError, InputError, shown
from directshape_torch.files.atomic_files import write_json
from directshape_torch.files.read_files import read_json
from directshape_torch.geometry.disparity_field import NUM_COEFFICIENTS, TENSOR_SHAPES, DisparityField
from directshape_torch.rig.estimate import RigEstimate, to_tensor

# These are the names in the folder of a run.
RIG_FILE, RIG_PICTURE = "rig.json", "rig.png"
RIGS, FIELD, SCHEMA_VERSION = "directshape rig", "directshape disparity field", 1
_CURE = "make it again with 'directshape calibrate-rig'"
_EXACT = [[0.0] * NUM_COEFFICIENTS] * NUM_COEFFICIENTS


def save_rigs(path: Path | str, rigs: Sequence[RigEstimate]) -> None:
    """Write the estimates of one or several rigs; a reader sees the old file or the new one, never half of it."""
    entries = [{**rig.content(), "says": str(rig)} for rig in rigs]
    write_json(path, {"schema": RIGS, "schema_version": SCHEMA_VERSION, "rigs": entries})


def load_rigs(path: Path | str) -> list[RigEstimate]:
    """The estimates in a file.

    Raises:
        DataFormatError: the file is missing, damaged, or holds no estimates.
    """
    content = _read(path, RIGS)
    try:
        return [RigEstimate.of_content(entry) for entry in content["rigs"]]
    except (KeyError, TypeError, InputError) as error:
        raise DataFormatError(path, f"is damaged ({error.__cause__ or error!r})", cure=_CURE) from error


def save_field(field: DisparityField, path: Path | str) -> None:
    """Write a field alone, for example one that is given and not estimated."""
    tensors = {name: getattr(field, name).double().cpu().tolist() for name in TENSOR_SHAPES}
    known = {"size_wh": list(field.size_wh), "provenance": dict(field.provenance)}
    write_json(path, {"schema": FIELD, "schema_version": SCHEMA_VERSION, **known, **tensors})


def load_field(path: Path | str) -> DisparityField:
    """Read a field written by `save_field`, float64; a field without `covariance` counts as exact.

    Raises:
        DataFormatError: the file is missing, is not valid JSON, or does not hold what a field needs.
    """
    content = {"covariance": _EXACT, "provenance": {}} | _read(path, FIELD)
    size, provenance = content.get("size_wh"), content["provenance"]
    try:
        if not (isinstance(size, list) and len(size) == 2 and all(type(n) is int and n > 0 for n in size)):
            raise ValueError(f"'size_wh' must be [width, height], got {shown(size)}")
        if not isinstance(provenance, dict):
            raise ValueError(f"'provenance' must be an object, got {shown(provenance)}")
        tensors = {name: to_tensor(content, name, shape) for name, shape in TENSOR_SHAPES.items()}
        return DisparityField(size_wh=(size[0], size[1]), provenance=provenance, **tensors)
    except ValueError as error:
        raise DataFormatError(path, str(error), cure="write it again with `save_field`") from error


def load_fields(path: Path | str) -> tuple[DisparityField, ...]:
    """The fields in a file of `save_rigs` or of `save_field`; a bad file raises `DataFormatError`."""
    return tuple(rig.field for rig in load_rigs(path)) if holds_rigs(path) else (load_field(path),)


def known_rigs(name: str) -> list[RigEstimate]:
    """Estimates in the file that `--rig` names; the list is empty for "none" and for a file of a field."""
    return load_rigs(name) if name != "none" and holds_rigs(name) else []


def holds_rigs(path: Path | str) -> bool:
    """Whether a JSON file holds estimates, and not one field; a bad file raises `DataFormatError`."""
    return _read(path).get("schema") == RIGS


def _read(path: Path | str, schema: str | None = None) -> dict[str, Any]:
    content = read_json(path, _CURE)
    if not isinstance(content, dict):
        raise DataFormatError(path, "is no JSON object", cure=_CURE)
    if schema is not None and (content.get("schema"), content.get("schema_version")) != (schema, SCHEMA_VERSION):
        found = f"got {shown(content.get('schema'))}, version {shown(content.get('schema_version'))}"
        what = "file of rigs" if schema == RIGS else "disparity field"
        raise DataFormatError(path, f"is no {what} (schema {schema!r}, version {SCHEMA_VERSION}), {found}", cure=_CURE)
    return content
