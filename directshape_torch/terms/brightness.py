"""One brightness for both images of a car: exposure and gain of two cameras are never quite the same."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from directshape_torch.rows import CarSums

Brightness = Literal["none", "gain", "affine"]

# Two exposures differ by a few percent; more is a wrong pose.
_GAIN_BOUNDS = (0.8, 1.25)
# Contrast in grey levels that a car has at least: noise on an even one says nothing of the gain.
_LEAST_CONTRAST = 5.0


def matched_brightness(
    form: Brightness,
    left: Tensor,  # (N, M, R) grey levels
    right: Tensor,  # (N, M, R) grey levels where the neighbourhoods land
    weight: Tensor,  # (N, M, R) of the neighbours
    owner: Tensor,  # (M,) car of each block
    num_cars: int,
) -> Tensor:
    """The left grey levels (N, M, R) brought to the brightness of the right image, car by car; differentiable.

    In closed form, by moments: "gain" makes the means equal by a factor, "affine" means and standard deviations by a
    factor and an offset. Moments need no pixel to lie on its counterpart; a regression of one image on the other would
    take contrast off at every pose that is not yet right.

    Example:
        >>> left, weight, owner = torch.tensor([[[90.0, 110.0]]]), torch.ones(1, 1, 2), torch.tensor([0])
        >>> matched_brightness("gain", left, 1.1 * left, weight, owner, 1)
        tensor([[[ 99., 121.]]])
    """
    if form == "none":
        return left
    sums = CarSums.of(owner, num_cars)

    def total(values: Tensor) -> Tensor:
        return sums.sum((weight * values).sum(dim=(0, 2), dtype=torch.float64))

    def of_blocks(values: Tensor) -> Tensor:
        return values.to(left.dtype)[owner][:, None]

    total_left, total_right = total(left), total(right)
    if form == "gain":
        some = total_left > 0
        one = torch.ones_like(total_left)
        gain = torch.where(some, total_right / torch.where(some, total_left, one), one)
        return left * of_blocks(gain.clamp(*_GAIN_BOUNDS))
    count = total(torch.ones_like(left)).clamp_min(1)
    means = [x / count for x in (total_left, total_right)]
    centred = [x - of_blocks(mean) for x, mean in zip((left, right), means, strict=True)]
    deviation_left, deviation_right = ((total(x * x) / count + _LEAST_CONTRAST**2).sqrt() for x in centred)
    gain = (deviation_right / deviation_left).clamp(*_GAIN_BOUNDS)
    return left * of_blocks(gain) + of_blocks(means[1] - gain * means[0])
