"""Hashes of what a run is made of, by content, so that they do not depend on a file's name or compression."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from directshape_torch.geometry.disparity_field import DisparityField
from directshape_torch.shape.shape_prior import ShapePrior


def hash_tensors(tensors: Mapping[str, Tensor]) -> str:
    """The sha256 (hexadecimal) of named tensors: name, shape and values as float64, little-endian, in order of name.

    Examples:
        >>> hash_tensors({"a": torch.zeros(2)}) == hash_tensors({"a": torch.zeros(2, dtype=torch.float64)})
        True
    """
    digest = hashlib.sha256()
    for name in sorted(tensors):
        values = tensors[name].detach().to("cpu", torch.float64).contiguous().numpy()
        digest.update(json.dumps([name, list(values.shape)]).encode())
        digest.update(values.astype("<f8", copy=False).tobytes())
    return digest.hexdigest()


def hash_prior(prior: ShapePrior) -> str:
    """The sha256 of a shape prior: of its buffers, weights and bounds."""
    tensors = {**dict(prior.named_buffers()), **dict(prior.named_parameters())}
    return hash_tensors({"bounds_obj": prior.bounds_obj, **tensors})


def hash_fields(fields: Sequence[DisparityField]) -> str | None:
    """The sha256 of residual disparity fields, or None without any; of one alone, that of its tensors."""
    hashes = []
    for field in fields:
        tensors = {name: value for name, value in vars(field).items() if isinstance(value, Tensor)}
        hashes.append(hash_tensors({"size_wh": torch.tensor(field.size_wh), **tensors}))
    if len(hashes) < 2:
        return hashes[0] if hashes else None
    return hashlib.sha256("".join(hashes).encode()).hexdigest()
