"""The safetensors file of a neural shape prior: its tensors by name, everything else in the description."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path

import torch

from directshape_torch.errors import DataFormatError, InputError
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
        if len(settings["layer_widths"]) > len(tensors) or math.prod((nx, ny, nz)) > _MOST_NODES:
            raise ValueError(f"more layers than tensors, or more than {_MOST_NODES} nodes")
        provenance = PriorProvenance(**description["provenance"])
        # Without memory and random numbers until it is filled: the sizes are those that somebody has written down.
        with torch.device("meta"):
            prior = NeuralShapePrior(origin=torch.zeros(3), grid_shape=(nx, ny, nz), provenance=provenance, **settings)
        prior.load_state_dict(tensors, assign=True)
    except (InputError, KeyError, TypeError, ValueError, RuntimeError) as problem:
        raise DataFormatError(path, f"it describes no neural prior: {problem}", cure=CURE) from problem
    return prior
