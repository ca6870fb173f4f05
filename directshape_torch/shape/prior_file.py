"""The npz file of a PCA shape prior: plain arrays and JSON text, no pickle, written atomically."""

from __future__ import annotations

import json
import os
import zipfile
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.shape.pca_prior import PCAShapePrior, PriorProvenance

SCHEMA = "directshape_torch.pca_shape_prior/1"
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
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as file:
            np.savez_compressed(file, **arrays)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def read_prior(path: Path) -> PCAShapePrior:
    """Read a prior, float32 on the CPU.

    Raises:
        DataFormatError: missing, unreadable, of another schema, or with arrays that do not fit together.
    """
    arrays = _read_arrays(path)
    schema = str(arrays["schema"]) if "schema" in arrays else "none"
    if schema != SCHEMA:
        raise DataFormatError(
            path, f"schema {schema!r} is not {SCHEMA!r}", cure="rebuild it with: directshape build-prior"
        )
    missing = [name for name in (*_GRIDS, *_VECTORS, "spacing_m", "provenance") if name not in arrays]
    if missing:
        raise DataFormatError(path, f"lacks the arrays {', '.join(missing)}")
    tensors = {name: _finite_tensor(path, name, arrays[name]) for name in (*_GRIDS, *_VECTORS)}
    try:
        provenance = PriorProvenance(**json.loads(str(arrays["provenance"])))
        return PCAShapePrior(spacing_m=float(arrays["spacing_m"]), provenance=provenance, **tensors)
    except (InputError, TypeError, ValueError) as problem:
        raise DataFormatError(path, f"not a valid shape prior: {problem}") from problem


def _read_arrays(path: Path) -> dict[str, NDArray[np.generic]]:
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            if not isinstance(file, np.lib.npyio.NpzFile):
                raise DataFormatError(path, "not an npz archive")
            return {name: file[name] for name in file.files}
    except FileNotFoundError as problem:
        raise DataFormatError(path, "no such file", cure="make one with: directshape build-prior") from problem
    except (OSError, ValueError, zipfile.BadZipFile) as problem:
        if isinstance(problem, DataFormatError):
            raise
        raise DataFormatError(path, f"cannot be read as an npz archive without pickle ({problem})") from problem


def _finite_tensor(path: Path, name: str, array: NDArray[np.generic]) -> torch.Tensor:
    if not np.issubdtype(array.dtype, np.floating) or not np.isfinite(array).all():
        raise DataFormatError(path, f"{name} holds values that are no finite floating-point numbers")
    return torch.from_numpy(array.astype(np.float32))
