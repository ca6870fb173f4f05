"""The npz file of a PCA shape prior: plain arrays and JSON text, no pickle, written atomically."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.files.atomic_files import replaced_file
from directshape_torch.files.read_files import parse_json, read_npz
from directshape_torch.shape.pca_prior import PCAShapePrior, PriorProvenance

SCHEMA = "directshape_torch.pca_shape_prior/1"
_CURE = "make one with: directshape build-prior"
_GRIDS = ("mean", "basis")
_VECTORS = (
    "origin",
    "explained_variance_ratio",
    "dimensions_mean_hwl",
    "dimensions_basis_hwl",
    "dimensions_std_hwl",
)


def write_prior(prior: PCAShapePrior, path: Path, grid_dtype: str = "float32") -> None:
    """Write a prior; a reader never sees a half-written file.

    Raises:
        InputError: `grid_dtype` is not float16, float32 or float64.
    """
    if grid_dtype not in ("float16", "float32", "float64"):
        raise InputError("grid_dtype", "float16, float32 or float64", repr(grid_dtype))
    arrays = {name: getattr(prior, name).cpu().numpy().astype(grid_dtype) for name in _GRIDS}
    arrays |= {name: getattr(prior, name).cpu().numpy().astype(np.float64) for name in _VECTORS}
    arrays["spacing_m"] = np.float64(prior.spacing_m)
    arrays["schema"] = np.array(SCHEMA)
    arrays["provenance"] = np.array(json.dumps(asdict(prior.provenance)))
    with replaced_file(path) as file:
        np.savez_compressed(file, **arrays)


def read_prior(path: Path) -> PCAShapePrior:
    """Read a prior, float32 on the CPU.

    Raises:
        DataFormatError: missing, unreadable, of another schema, or with arrays that do not fit together.
    """
    arrays = read_npz(path, _CURE)
    schema = str(arrays["schema"]) if "schema" in arrays else "none"
    if schema != SCHEMA:
        raise DataFormatError(path, f"schema {schema!r} is not {SCHEMA!r}", cure=_CURE)
    missing = [name for name in (*_GRIDS, *_VECTORS, "spacing_m", "provenance") if name not in arrays]
    if missing:
        raise DataFormatError(path, f"lacks the arrays {', '.join(missing)}")
    tensors = {name: _finite_tensor(path, name, arrays[name]) for name in (*_GRIDS, *_VECTORS)}
    try:
        provenance = PriorProvenance(**parse_json(path, str(arrays["provenance"])))
        return PCAShapePrior(spacing_m=float(arrays["spacing_m"]), provenance=provenance, **tensors)
    except (InputError, TypeError, ValueError) as problem:
        raise DataFormatError(path, f"not a valid shape prior: {problem}") from problem


def _finite_tensor(path: Path, name: str, array: NDArray[np.generic]) -> torch.Tensor:
    if not np.issubdtype(array.dtype, np.floating) or not np.isfinite(array).all():
        raise DataFormatError(path, f"{name} holds values that are no finite floating-point numbers")
    return torch.from_numpy(array.astype(np.float32))
