"""Photometric residuals that do not see the brightness of a neighbourhood, or neither its brightness nor its contrast.

Exposure that differs between the cameras, vignetting and veiling glare change both slowly over the image, so over eight
pixels they are an offset and a factor. What is left is what the neighbourhoods look like.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

PatchForm = Literal["plain", "zero_mean", "normalised"]


def patch_residual(
    residual: Tensor,  # (..., P, N) right minus left, grey levels
    intensity_left: Tensor,  # (P, N) grey levels
    weight: Tensor,  # (P, N) 1 for neighbours that count, 0 for the others
    form: PatchForm,
    contrast_floor: float,  # grey levels
) -> Tensor:
    """Residuals (..., P, N) of neighbourhoods in grey levels of the left image.

    "zero_mean" takes the mean off both neighbourhoods; "normalised" (as in normalised cross-correlation) also gives the
    right one the contrast of the left one. A contrast counts as at least the floor, so that noise is not blown up where
    there is no texture.

    Example:
        >>> left, weight = torch.tensor([[90.0, 110.0]]), torch.ones(1, 2)
        >>> brighter = 0.5 * left + 30
        >>> patch_residual(brighter - left, left, weight, "zero_mean", 1e-3)
        tensor([[ 5., -5.]])
        >>> patch_residual(brighter - left, left, weight, "normalised", 1e-3).round(decimals=3)
        tensor([[0., 0.]])
    """
    if form == "plain":
        return residual
    if form == "zero_mean":
        return _centred(residual, weight)
    left, right = _centred(intensity_left, weight), _centred(residual + intensity_left, weight)
    return _contrast(left, weight, contrast_floor) / _contrast(right, weight, contrast_floor) * right - left


def patch_derivative(
    J_residual_depth: Tensor,  # (P, N) of the plain residual, grey levels per metre
    residual: Tensor,  # (P, N) plain
    intensity_left: Tensor,  # (P, N)
    weight: Tensor,  # (P, N)
    form: PatchForm,
    contrast_floor: float,
) -> Tensor:
    """Derivatives (P, N) of `patch_residual` by the one depth of each pixel: multiples of one row, as the plain ones.

    With the right neighbourhood x, its mean taken off, and c its contrast: `d(x / c) = (dx - y mean(y dx)) / c` where
    `y = x / c`, whatever the floor.

    Example:
        >>> J, left, weight = torch.tensor([[1.0, 3.0]]), torch.zeros(1, 2), torch.ones(1, 2)
        >>> patch_derivative(J, left, left, weight, "zero_mean", 1.0)
        tensor([[-1.,  1.]])
    """
    if form == "plain":
        return J_residual_depth
    J = _centred(J_residual_depth, weight)
    if form == "zero_mean":
        return J
    left, right = _centred(intensity_left, weight), _centred(residual + intensity_left, weight)
    contrast = _contrast(right, weight, contrast_floor)
    unit = right / contrast
    return _contrast(left, weight, contrast_floor) / contrast * (J - unit * _mean(unit * J, weight))


def _mean(values: Tensor, weight: Tensor) -> Tensor:
    """Mean (..., P, 1) over the neighbours that count; zero where none does."""
    return (weight * values).sum(dim=-1, keepdim=True) / weight.sum(dim=-1, keepdim=True).clamp_min(1)


def _centred(values: Tensor, weight: Tensor) -> Tensor:
    return values - _mean(values, weight)


def _contrast(centred: Tensor, weight: Tensor, floor: float) -> Tensor:
    """Standard deviation (..., P, 1), the floor added in squares: smooth, so that its derivative has no kink."""
    return torch.sqrt(_mean(centred * centred, weight) + floor**2)
