"""This module estimates a detector's errors from the differences between refined cars and its boxes.

The method is empirical Bayes. The differences have a Student-t distribution, whose variance is the sum of the variances
of detector and images. Each standard deviation of the detector is averaged over a grid, with a prior that covers
detectors from LiDAR to one camera. A detector that is good at one quantity is mostly good at the others. Therefore a
common factor joins the seven quantities, so that a few cars show how good the detector is.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from directshape_torch.refinement.fusion import DetectorComparison

NUM_COLUMNS = 15
"""This is the number of columns of the rows that `rows_of` makes."""

# The prior of the detectors' standard deviations has this middle and this spread of the logarithm. The standard
# deviation of the depth is a share of the distance. Sideways position, height above ground, heading (times 2 m),
# length, width and height are in metres.
_MIDDLE = (0.02, 0.12, 0.06, 0.16, 0.35, 0.08, 0.08)
_SPREAD = (1.2, 0.8, 0.6, 1.0, 0.5, 0.5, 0.5)
# The grid of standard deviations holds these multiples of the middle.
_TRIED = torch.linspace(-4, 3, 71, dtype=torch.float64).exp()
_DEGREES_OF_FREEDOM = 4
# The common factor takes these values, in standard deviations of detectors, and explains this share of the spreads.
# With a smaller share single frames cannot distinguish LiDAR from a camera.
_FACTORS = torch.linspace(-3, 3, 25, dtype=torch.float64)
_COMMON_SHARE = 0.8
# Results keep something of their start, and the energy holds shapes to the detector's dimensions. Therefore the
# differences show only this share of the detector's errors.
_SHOWN = (0.77, 0.77, 0.77, 0.77, 0.5, 0.5, 0.5)


def rows_of(comparison: DetectorComparison) -> Tensor:
    """Rows (N, 15) of compared cars: distance in metres, seven differences, seven standard deviations."""
    parts = comparison.distance[:, None], comparison.difference, comparison.sigma_images
    rows = torch.cat(parts, dim=1).detach()
    return rows[rows.isfinite().all(dim=1)].cpu()


def detector_sigmas(
    rows: Tensor,  # (N, 15) float64
) -> Tensor:  # (7,)
    """Estimate the detector's standard deviations in `CAR_QUANTITIES`: a share of the distance for the depth, else
    metres.

    Examples:
        >>> noise = torch.randn(500, 7, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        >>> rows = torch.cat([torch.ones(500, 1), 0.3 * noise, torch.full((500, 7), 0.01)], dim=1)
        >>> [round(float(sigma), 1) for sigma in detector_sigmas(rows)[1:4]]
        [0.3, 0.3, 0.3]
    """
    distance, difference, sigma = rows[:, 0], rows[:, 1:8], rows[:, 8:]
    units = torch.ones_like(difference)
    units[:, 0] = distance
    middle, spread, shown = (torch.tensor(x, dtype=torch.float64) for x in (_MIDDLE, _SPREAD, _SHOWN))
    noise = _TRIED[:, None] * middle
    variance = (noise[:, None] * units) ** 2 + sigma**2
    nu = _DEGREES_OF_FREEDOM
    log_likelihood = -0.5 * (variance.log() + (nu + 1) * torch.log1p(difference**2 / variance / nu)).sum(dim=1)
    # The standard deviations of the grid (S, 1, 7) have a prior that depends on the common factor (C, 1).
    standard, factor = ((noise / middle).log() / spread)[:, None], _FACTORS[:, None]
    log_prior = -0.5 * (standard - math.sqrt(_COMMON_SHARE) * factor) ** 2 / (1 - _COMMON_SHARE)
    joint = log_likelihood[:, None] + log_prior.log_softmax(dim=0)
    mean = (joint.softmax(dim=0) * noise.log()[:, None]).sum(dim=0)
    of_factor = (joint.logsumexp(dim=0).sum(dim=1) - 0.5 * _FACTORS**2).softmax(dim=0)
    return (of_factor[:, None] * mean).sum(dim=0).exp() / shown


def in_words(sigmas: Tensor) -> str:
    """Standard deviations (7,) in one line."""
    depth, sideways, up, heading, length, width, height = sigmas.tolist()
    turn = math.degrees(heading / 2)
    return (
        f"depth {depth:.1%}, sideways {sideways:.2f} m, height above ground {up:.2f} m, heading {turn:.1f} deg, "
        f"length {length:.2f} m, width {width:.2f} m, height {height:.2f} m"
    ).replace("%", " %")
