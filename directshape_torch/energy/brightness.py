"""One brightness for both images of a car: exposure and gain of two cameras are never quite the same."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from directshape_torch.solver.normal_equations import Segments

Brightness = Literal["none", "gain", "affine"]

# Two exposures differ by a few percent; more is a wrong pose.
_GAIN_BOUNDS = (0.8, 1.25)
# Contrast in grey levels that a car has at least: noise on an even one says nothing of the gain.
_LEAST_CONTRAST = 5.0


def matched_brightness(
    form: Brightness,
    left: Tensor,  # (Q, N) grey levels
    right: Tensor,  # (Q, N) grey levels where the neighbourhoods land
    weight: Tensor,  # (Q, N) of the neighbours
    segments: Segments,  # of the Q pixels
) -> Tensor:
    """The left grey levels (Q, N) brought to the brightness of the right image, car by car; differentiable.

    In closed form, by moments: "gain" makes the means equal by a factor, "affine" means and standard deviations by a
    factor and an offset. Moments need no pixel to lie on its counterpart; a regression of one image on the other would
    take contrast off at every pose that is not yet right.

    Example:
        >>> left, weight = torch.tensor([[90.0, 110.0], [100.0, 100.0]]), torch.ones(2, 2)
        >>> segments = Segments.of_sorted(torch.tensor([0, 0]), 1)
        >>> matched_brightness("gain", left, 1.1 * left, weight, segments)
        tensor([[ 99., 121.],
                [110., 110.]])
    """
    if form == "none":
        return left
    gain, offset = (_gain if form == "gain" else _affine)(left, right, weight, segments)
    factor, shift = (x.to(left.dtype)[segments.object_index, None] for x in (gain, offset))
    return left * factor + shift


def _gain(left: Tensor, right: Tensor, weight: Tensor, segments: Segments) -> tuple[Tensor, Tensor]:
    total_left, total_right = (segments.sum((weight * x).sum(dim=1)) for x in (left, right))
    some = total_left > 0
    one = torch.ones_like(total_left)
    gain = torch.where(some, total_right / torch.where(some, total_left, one), one)
    return gain.clamp(*_GAIN_BOUNDS), torch.zeros_like(gain)


def _affine(left: Tensor, right: Tensor, weight: Tensor, segments: Segments) -> tuple[Tensor, Tensor]:
    (mean_left, deviation_left), (mean_right, deviation_right) = (_moments(x, weight, segments) for x in (left, right))
    gain = (deviation_right / deviation_left).clamp(*_GAIN_BOUNDS)
    return gain, mean_right - gain * mean_left


def _moments(values: Tensor, weight: Tensor, segments: Segments) -> tuple[Tensor, Tensor]:
    """Mean (B,) and standard deviation (B,) of the neighbours that count."""
    count = segments.sum(weight.sum(dim=1)).clamp_min(1)
    mean = segments.sum((weight * values).sum(dim=1)) / count
    centred = values - mean.to(values.dtype)[segments.object_index, None]
    variance = segments.sum((weight * centred * centred).sum(dim=1)) / count
    return mean, (variance + _LEAST_CONTRAST**2).sqrt()
