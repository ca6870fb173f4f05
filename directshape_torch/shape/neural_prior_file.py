"""The safetensors file of a neural shape prior: its tensors by name, everything else in the description."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import torch
from torch import Tensor

from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.shape.neural_prior import NeuralShapePrior
from directshape_torch.shape.pca_prior import PriorProvenance
from directshape_torch.shape.tensor_file import read_tensors, write_tensors

SCHEMA = "directshape_torch.neural_shape_prior/1"
CURE = "make one with: python scripts/train_neural_prior.py"


def write_neural_prior(prior: NeuralShapePrior, path: Path) -> None:
    """Write a prior, its weights as they are; a reader never sees a half-written file."""
    tensors = {**dict(prior.named_parameters()), **dict(prior.named_buffers())}
    description = {
        "schema": SCHEMA,
        "layer_widths": prior.layer_widths,
        "num_codes": prior.num_codes,
        "grid_shape": prior.grid_shape,
        "spacing_m": prior.spacing_m,
        "provenance": asdict(prior.provenance),
    }
    write_tensors(path, tensors, description)


def read_neural_prior(path: Path) -> NeuralShapePrior:
    """Read a prior, float32 on the CPU.

    Raises:
        DataFormatError: missing, truncated, of another schema, or with tensors that do not fit together.
    """
    tensors, description = read_tensors(path, SCHEMA, CURE)
    try:
        settings = {name: description[name] for name in ("layer_widths", "num_codes", "spacing_m")}
        nx, ny, nz = description["grid_shape"]
        provenance = PriorProvenance(**description["provenance"])
        prior = NeuralShapePrior(origin=torch.zeros(3), grid_shape=(nx, ny, nz), provenance=provenance, **settings)
    except (InputError, KeyError, TypeError, ValueError) as problem:
        raise DataFormatError(path, f"it describes no neural prior: {problem!r}", cure=CURE) from problem
    _fill(path, prior, tensors)
    return prior


def _fill(path: Path, prior: NeuralShapePrior, tensors: dict[str, Tensor]) -> None:
    places = {**dict(prior.named_parameters()), **dict(prior.named_buffers())}
    if places.keys() != tensors.keys():
        different = ", ".join(sorted(places.keys() ^ tensors.keys()))
        raise DataFormatError(path, f"tensors that are missing or too many: {different}", cure=CURE)
    for name, place in places.items():
        if place.shape != tensors[name].shape:
            raise DataFormatError(path, f"{name}: expected {tuple(place.shape)}, got {tuple(tensors[name].shape)}")
        place.data.copy_(tensors[name])
