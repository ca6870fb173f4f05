"""What is trained: a network over crops and box features, and its baseline, the same corrections as constants."""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate

from refiner_training.car_frames import NUM_FEATURES, CarInputs

Parts = Literal["weights", "masks", "both"]

# The tilt prior only keeps a car upright.
TERMS = ("silhouette_left", "silhouette_right", "photometric", "shape", "height", "dimensions")
LARGEST_FACTOR = 4.0
LARGEST_RESIDUAL = 6.0
# The silhouette clamps probabilities to [0.01, 0.99] and has no gradient outside.
_FLOOR, _START_FLOOR = 0.01, 0.015


class Correction(NamedTuple):
    """What is changed in front of a refinement of B cars."""

    log_factors: Tensor  # (B, T) of the terms
    residual_left: Tensor | None  # (B, h, w) added to the logits of the mask, over its region; None: mask as it is
    residual_right: Tensor | None


class ConstantCorrector(nn.Module):
    """The same factors for every car, and one offset and gain for all logits of masks."""

    def __init__(self, parts: Parts) -> None:
        super().__init__()
        self.factors = nn.Parameter(torch.zeros(len(TERMS))) if parts != "masks" else None
        self.offset_and_gain = nn.Parameter(torch.zeros(2)) if parts != "weights" else None

    def forward(self, inputs: CarInputs) -> Correction:
        """Corrections of B cars."""
        log_factors = inputs.features.new_zeros(len(inputs.features), len(TERMS))
        if self.factors is not None:
            log_factors = log_factors + _bounded(self.factors, math.log(LARGEST_FACTOR))
        return Correction(log_factors, self._residual(inputs.crop_left), self._residual(inputs.crop_right))

    def _residual(self, crop: Tensor) -> Tensor | None:
        if self.offset_and_gain is None:
            return None
        offset, gain = self.offset_and_gain
        return _bounded(offset + gain * mask_logits(crop[:, 3]), LARGEST_RESIDUAL)


class CropNetwork(nn.Module):
    """Factors from crops and box features, residual logits from crops by a small fully convolutional network.

    Args:
        parts: what it proposes.
        channels: of the convolutions.
        hidden: of the perceptron.
    """

    def __init__(self, parts: Parts, channels: int = 12, hidden: int = 24) -> None:
        super().__init__()
        self.encoder, self.factors, self.residual = None, None, None
        if parts != "masks":
            self.encoder = nn.Sequential(
                nn.Conv2d(4, channels, 3, stride=2, padding=1), nn.ReLU(),
                nn.Conv2d(channels, channels, 3, stride=2, padding=1), nn.ReLU(),
                nn.AdaptiveAvgPool2d(1), nn.Flatten(),
            )  # fmt: skip
            last = nn.Linear(hidden, len(TERMS))
            self.factors = nn.Sequential(nn.Linear(NUM_FEATURES + 2 * channels, hidden), nn.Tanh(), _zeroed(last))
        if parts != "weights":
            self.residual = nn.Sequential(
                nn.Conv2d(4, channels, 3, padding=1), nn.ReLU(),
                nn.Conv2d(channels, channels, 3, padding=2, dilation=2), nn.ReLU(),
                nn.Conv2d(channels, channels, 3, padding=4, dilation=4), nn.ReLU(),
                _zeroed(nn.Conv2d(channels, 1, 1)),
            )  # fmt: skip

    def forward(self, inputs: CarInputs) -> Correction:
        """Corrections of B cars."""
        left, right = _centred(inputs.crop_left), _centred(inputs.crop_right)
        log_factors = inputs.features.new_zeros(len(inputs.features), len(TERMS))
        if self.encoder is not None and self.factors is not None:
            seen = torch.cat([inputs.features, self.encoder(left), self.encoder(right)], dim=1)
            log_factors = _bounded(self.factors(seen), math.log(LARGEST_FACTOR))
        return Correction(log_factors, self._residual(left), self._residual(right))

    def _residual(self, crop: Tensor) -> Tensor | None:
        return None if self.residual is None else _bounded(self.residual(crop)[:, 0], LARGEST_RESIDUAL)


def mask_logits(probability: Tensor) -> Tensor:
    """Logits of probabilities, taken relative to (0.01, 0.99) and kept from its ends, where gradients would vanish."""
    inner = (probability.clamp(_START_FLOOR, 1 - _START_FLOOR) - _FLOOR) / (1 - 2 * _FLOOR)
    return torch.logit(inner)


def corrected_masks(
    masks: Tensor,  # (B, H, W)
    regions: Tensor,  # (B, 4)
    residual: Tensor | None,  # (B, h, w)
) -> Tensor:
    """Masks whose logits have the residual added, spread over each region; within (0.01, 0.99) there."""
    if residual is None or not len(masks):
        return masks
    changed = []
    for car, (u0, v0, u1, v1) in enumerate(regions.tolist()):
        mask = masks[car].clone()
        if u1 > u0 and v1 > v0:
            size_hw = (v1 - v0, u1 - u0)
            spread = interpolate(residual[car, None, None], size_hw, mode="bilinear", align_corners=False)[0, 0]
            logits = mask_logits(mask[v0:v1, u0:u1]) + spread
            mask[v0:v1, u0:u1] = _FLOOR + (1 - 2 * _FLOOR) * torch.sigmoid(logits)
        changed.append(mask)
    return torch.stack(changed)


def _centred(crop: Tensor) -> Tensor:
    """Colours without their mean, and the mask, about zero."""
    colours = crop[:, :3] - crop[:, :3].mean(dim=(1, 2, 3), keepdim=True)
    return torch.cat([3 * colours, 2 * crop[:, 3:] - 1], dim=1)


def _bounded(value: Tensor, limit: float) -> Tensor:
    return limit * torch.tanh(value / limit)


def _zeroed(layer: nn.Linear | nn.Conv2d) -> nn.Module:
    """A last layer that proposes nothing until it is trained."""
    nn.init.zeros_(layer.weight)
    if layer.bias is not None:
        nn.init.zeros_(layer.bias)
    return layer
