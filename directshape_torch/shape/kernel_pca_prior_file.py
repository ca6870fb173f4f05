"""The safetensors file of a kernel PCA shape prior."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import torch
from torch import Tensor

from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.shape.kernel_pca_prior import KernelPCAShapePrior
from directshape_torch.shape.pca_prior import PCAShapePrior, PriorProvenance
from directshape_torch.shape.tensor_file import read_tensors, write_tensors

SCHEMA = "directshape_torch.kernel_pca_shape_prior/1"
CURE = "make one with: python scripts/build_kernel_prior.py"

_GRIDS = ("subspace.mean", "subspace.basis")


def write_kernel_prior(prior: KernelPCAShapePrior, path: Path) -> None:
    """Write a prior; a reader never sees a half-written file."""
    tensors = dict(prior.named_buffers())
    tensors |= {name: tensors[name].to(torch.float16) for name in _GRIDS}
    description = {
        "schema": SCHEMA,
        "spacing_m": prior.spacing_m,
        "provenance": asdict(prior.provenance),
    }
    write_tensors(path, tensors, description)


def read_kernel_prior(path: Path) -> KernelPCAShapePrior:
    """Read a prior, float32 on the CPU.

    Raises:
        DataFormatError: missing, truncated, of another schema, or with tensors that do not fit together.
    """
    tensors, description = read_tensors(path, SCHEMA, CURE)
    try:
        provenance = PriorProvenance(**description["provenance"])
        subspace = PCAShapePrior(
            spacing_m=float(description["spacing_m"]), provenance=provenance, **_below(tensors, "subspace.")
        )
        own = {name: tensor for name, tensor in tensors.items() if "." not in name}
        return KernelPCAShapePrior(subspace, **own)
    except (InputError, KeyError, TypeError, ValueError) as problem:
        raise DataFormatError(path, f"not a valid kernel PCA prior: {problem!r}", cure=CURE) from problem


def _below(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}
