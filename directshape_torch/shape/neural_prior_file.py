"""The safetensors file of a neural shape prior: its tensors by name, everything else in the description."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from directshape_torch.errors import DataFormatError, InputError, shown
from directshape_torch.shape.neural_prior import NeuralShapePrior
from directshape_torch.shape.pca_prior import PriorProvenance
from directshape_torch.shape.tensor_file import read_tensors, write_tensors

_MOST_NODES = 2**24
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
        _check_sizes(settings, math.prod((nx, ny, nz)), tensors)
        provenance = PriorProvenance(**description["provenance"])
        prior = NeuralShapePrior(origin=torch.zeros(3), grid_shape=(nx, ny, nz), provenance=provenance, **settings)
    except (InputError, KeyError, IndexError, TypeError, ValueError, RuntimeError) as problem:
        raise DataFormatError(path, f"it describes no neural prior: {problem!r}", cure=CURE) from problem
    _fill(path, prior, tensors)
    return prior


def _check_sizes(settings: dict[str, Any], num_nodes: int, tensors: dict[str, Tensor]) -> None:
    """Raise `ValueError` unless the layers are those of the tensors: a network is made before it is filled."""
    widths = [len(tensors[f"layers.{layer}.weight"]) for layer in range(len(settings["layer_widths"]))]
    num_codes = tensors["dimensions_linear_hwl"].shape[-1]
    if settings["layer_widths"] != widths or settings["num_codes"] != num_codes:
        raise ValueError(f"layers {shown(settings)} expected, tensors of widths {widths} and {num_codes} codes found")
    if num_nodes > _MOST_NODES:
        raise ValueError(f"a grid of {num_nodes} nodes, at most {_MOST_NODES} are measured")


def _fill(path: Path, prior: NeuralShapePrior, tensors: dict[str, Tensor]) -> None:
    places = {**dict(prior.named_parameters()), **dict(prior.named_buffers())}
    if places.keys() != tensors.keys():
        different = ", ".join(sorted(places.keys() ^ tensors.keys()))
        raise DataFormatError(path, f"tensors that are missing or too many: {different}", cure=CURE)
    for name, place in places.items():
        if place.shape != tensors[name].shape:
            raise DataFormatError(path, f"{name}: expected {tuple(place.shape)}, got {tuple(tensors[name].shape)}")
        place.data.copy_(tensors[name])
