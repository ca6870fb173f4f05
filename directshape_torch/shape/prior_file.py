"""Files of shape priors are named tensors with a description, in the safetensors format, which cannot run code."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor

from directshape_torch.errors import DataFormatError, InputError, shown
from directshape_torch.files.atomic_files import write_bytes
from directshape_torch.files.read_files import parse_json, read_bytes
from directshape_torch.numerics.checks import check_type

# The description is JSON text under one key, because the order of several keys in the file is not fixed.
_KEY = "description"
_NOT_WHOLE = "not a whole safetensors file"

_PriorT = TypeVar("_PriorT")


@dataclass(frozen=True)
class PriorProvenance:
    """A `PriorProvenance` says where a prior comes from, and is kept inside the prior's file."""

    made_by: str
    licence: str
    num_samples: int
    remarks: str = ""
    of_cars: bool = True  # whether the shapes are passenger cars, and their mean shape shall look like one

    def __post_init__(self) -> None:
        check_type("of_cars", self.of_cars, (bool,))


def write_prior(
    path: Path | str, schema: str, provenance: PriorProvenance, tensors: Mapping[str, Tensor], **settings: Any
) -> None:
    """Write a prior, atomically; the same content gives the same bytes."""
    from safetensors.torch import save

    description = {"schema": schema, "provenance": asdict(provenance), **settings}
    on_cpu = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    write_bytes(Path(path), save(on_cpu, {_KEY: json.dumps(description, sort_keys=True)}))


def read_prior(
    path: Path | str,
    schema: str,
    cure: str,
    make: Callable[[dict[str, Tensor], PriorProvenance, dict[str, Any]], _PriorT],
) -> _PriorT:
    """The prior that `make` makes of the tensors (float32 on the CPU), the provenance and the settings in a file.

    Raises:
        DataFormatError: the file is missing, truncated or of another schema, has values that are not finite numbers,
            or has tensors and settings that do not fit together.
    """
    tensors, description = _read_tensors(Path(path), schema, cure)
    try:
        provenance = PriorProvenance(**description["provenance"])
        return make(tensors, provenance, description)
    except (InputError, KeyError, TypeError, ValueError, RuntimeError) as problem:
        raise DataFormatError(path, f"it describes no shape prior: {problem!r}", cure=cure) from problem


def read_description(path: Path, cure: str = "") -> dict[str, Any]:
    """The description in a safetensors file, which is empty where the file has none.

    Raises:
        DataFormatError: the file is missing, truncated or no safetensors file.
    """
    return _description(path, read_bytes(path, cure=cure), cure)


def _read_tensors(path: Path, schema: str, cure: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    from safetensors import SafetensorError
    from safetensors.torch import load

    content = read_bytes(path, cure=cure)
    description = _description(path, content, cure)
    found = description.get("schema", "none")
    if found != schema:
        raise DataFormatError(path, f"schema {shown(found)} is not {schema!r}", cure=cure)
    try:
        tensors = {name: (tensor.is_floating_point(), tensor.float()) for name, tensor in load(content).items()}
    except (SafetensorError, ValueError, KeyError, TypeError, RuntimeError) as problem:
        raise DataFormatError(path, f"{_NOT_WHOLE} ({problem})", cure=cure) from problem
    for name, (is_floating, tensor) in tensors.items():
        if not is_floating or not bool(torch.isfinite(tensor).all()):
            raise DataFormatError(path, f"{name} holds values that are no finite floating-point numbers")
    return {name: tensor for name, (_, tensor) in tensors.items()}, description


def _description(path: Path, content: bytes, cure: str) -> dict[str, Any]:
    """The description in the header of a file, which is eight bytes for its length, then JSON."""
    end = 8 + int.from_bytes(content[:8], "little")
    header = parse_json(path, content[8:end], cure, _NOT_WHOLE)
    metadata = header.get("__metadata__", {}) if isinstance(header, dict) and end <= len(content) else None
    text = metadata.get(_KEY, "{}") if isinstance(metadata, dict) else None
    if not isinstance(text, str):
        raise DataFormatError(path, _NOT_WHOLE, cure=cure)
    description = parse_json(path, text, cure)
    if not isinstance(description, dict):
        raise DataFormatError(path, f"a description that is no JSON object: {shown(description)}", cure=cure)
    return description
