"""Named tensors with a description in safetensors files, which hold no code and cannot run any."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from directshape_torch.errors import DataFormatError

# One key with JSON text, because the order of several keys in the file is not fixed.
_KEY = "description"


def write_tensors(path: Path, tensors: Mapping[str, Tensor], description: Mapping[str, Any]) -> None:
    """Write a safetensors file, atomically; the same content gives the same bytes."""
    from safetensors.torch import save

    on_cpu = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    content = save(on_cpu, {_KEY: json.dumps(description, sort_keys=True)})
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.write_bytes(content)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def read_description(path: Path, cure: str = "") -> dict[str, Any]:
    """The description in a safetensors file; empty where it has none.

    Raises:
        DataFormatError: no such file, or no safetensors file, or a truncated one.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt") as file:
            description = json.loads((file.metadata() or {}).get(_KEY, "{}"))
    except FileNotFoundError as problem:
        raise DataFormatError(path, "no such file", cure=cure) from problem
    except (OSError, ValueError, SafetensorError) as problem:
        raise DataFormatError(path, f"not a whole safetensors file ({problem})", cure=cure) from problem
    if not isinstance(description, dict):
        raise DataFormatError(path, f"a description that is no JSON object: {description!r}", cure=cure)
    return description


def read_tensors(path: Path, schema: str, cure: str = "") -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors as float32 on the CPU, and the description, of a file of `write_tensors`.

    Raises:
        DataFormatError: missing, truncated, of another schema, or with values that are not finite numbers.
    """
    from safetensors.torch import load_file

    description = read_description(path, cure)
    found = description.get("schema", "none")
    if found != schema:
        raise DataFormatError(path, f"schema {found!r} is not {schema!r}", cure=cure)
    tensors = load_file(path)
    for name, tensor in tensors.items():
        if not tensor.is_floating_point() or not bool(torch.isfinite(tensor).all()):
            raise DataFormatError(path, f"{name} holds values that are no finite floating-point numbers")
    return {name: tensor.to(torch.float32) for name, tensor in tensors.items()}, description
