"""A disparity field as a JSON file, for fields that are given and not estimated (schema 1)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from directshape_torch.errors import DataFormatError, shown
from directshape_torch.files.atomic_files import write_json
from directshape_torch.files.read_files import read_json
from directshape_torch.geometry.disparity_field import NUM_COEFFICIENTS, TENSOR_SHAPES, DisparityField

SCHEMA = "directshape disparity field"
SCHEMA_VERSION = 1
_CURE = "make a rig file with 'directshape calibrate-rig', or write it again with `save_field`"
_NOT_KNOWN = {"covariance": [[0.0] * NUM_COEFFICIENTS] * NUM_COEFFICIENTS}
"""What files of earlier versions lack."""


def save_field(field: DisparityField, path: Path | str) -> None:
    """Write the field as JSON; a reader sees the old file or the new one, never half of it.

    Raises:
        OSError: the folder cannot be made or written.
    """
    content = {
        "schema": SCHEMA,
        "schema_version": SCHEMA_VERSION,
        "size_wh": list(field.size_wh),
        "provenance": dict(field.provenance),
        **{name: getattr(field, name).double().cpu().tolist() for name in TENSOR_SHAPES},
    }
    write_json(path, content)


def load_field(path: Path | str) -> DisparityField:
    """Read a field written by `save_field`, float64.

    Raises:
        DataFormatError: the file is missing, is not valid JSON, or does not hold what a field needs.
    """
    content = _NOT_KNOWN | _read_json(path)
    tensors = {name: _read_tensor(path, content, name, shape) for name, shape in TENSOR_SHAPES.items()}
    size = content.get("size_wh")
    if not (isinstance(size, list) and len(size) == 2 and all(type(n) is int and n > 0 for n in size)):
        raise DataFormatError(path, f"'size_wh' must be [width, height], got {shown(size)}", cure=_CURE)
    provenance = content.get("provenance", {})
    if not isinstance(provenance, dict):
        raise DataFormatError(path, f"'provenance' must be an object, got {shown(provenance)}", cure=_CURE)
    return DisparityField(size_wh=(size[0], size[1]), provenance=provenance, **tensors)


def _read_json(path: Path | str) -> dict[str, Any]:
    content = read_json(path, _CURE)
    if not isinstance(content, dict) or content.get("schema") != SCHEMA:
        raise DataFormatError(path, f"is no disparity field (its 'schema' is not {SCHEMA!r})", cure=_CURE)
    if content.get("schema_version") != SCHEMA_VERSION:
        version = content.get("schema_version")
        raise DataFormatError(path, f"has schema version {shown(version)}, known is {SCHEMA_VERSION}", cure=_CURE)
    return content


def _read_tensor(path: Path | str, content: Mapping[str, Any], name: str, shape: tuple[int | None, ...]) -> Tensor:
    wanted = "(" + ", ".join("M" if n is None else str(n) for n in shape) + ")"
    try:
        tensor = torch.tensor(content[name], dtype=torch.float64)
    except (KeyError, TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise DataFormatError(path, f"{name!r} must be numbers of shape {wanted}", cure=_CURE) from error
    fits = tensor.ndim == len(shape) and all(n is None or n == m for n, m in zip(shape, tensor.shape, strict=False))
    if not fits or (name == "hull_uv" and len(tensor) < 3) or not all(map(math.isfinite, tensor.flatten().tolist())):
        raise DataFormatError(
            path, f"{name!r} must be finite numbers of shape {wanted}, got {tuple(tensor.shape)}", cure=_CURE
        )
    return tensor
