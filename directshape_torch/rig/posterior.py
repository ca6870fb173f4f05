"""This module solves for the rig's unknowns given all evidence (docs/derivations/rig.md).

    measured - implied disparity = field(u, v) + bias d + setback d^2 / (f b) + noise

`d` is the measured disparity. The implied disparity contains the detector's error, and a regressor that shares the
noise of the offset would bias the fit. The noise is Student-t of variance `(s d)^2 + s0^2 + sigma^2`. The noises and
the scale of the field are summed over a grid, so that uncertainty about them widens the covariance.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.geometry.disparity_field import NUM_COEFFICIENTS, polynomial_basis
from directshape_torch.rig.pixels import by_degree

BIAS, SETBACK = NUM_COEFFICIENTS, NUM_COEFFICIENTS + 1

# Rectification leaves errors of these standard deviations in pixels for each degree. They are larger towards the edges
# than in the middle, and smaller for rows. A rig may be better or exact, so each of the factors in `_FIELD_SCALES` is
# equally likely.
_FIELD_SIGMA_PX = (0.4, 0.4, 0.5, 0.3, 0.5)
_FIELD_SCALES = torch.tensor([1.0, 0.5, 0.25, 0.05], dtype=torch.float64)
_ROW_SIGMA_PX = (0.4, 0.3, 0.3, 0.2, 0.3)
_ROW_NOISE_PX = 0.1
# The bias of a detector is about as large as its noise.
_BIAS_OVER_NOISE = 1.5
# These are the relative standard deviations of a detector's dimensions in the mean of all cars, and of one car.
_DIMENSIONS_SIGMA, _SIZE_SIGMA = 0.04, 0.08
# Surfaces lie beside the near side of their boxes, at a distance that the cars of one detector share. This is the
# standard deviation of the distance.
_SETBACK_SIGMA_M = 0.15

_DEGREES_OF_FREEDOM = 4
_NUM_ITERATIONS = 30
# The grid holds standard deviations of a detector's relative depth, and of the noise in pixels that a perfect detector
# would leave. The prior of each is the middle and the spread of the logarithm over detectors from LiDAR to one camera.
_DEPTH_NOISE, _DEPTH_NOISE_PRIOR = torch.logspace(-2.7, -0.7, 15, dtype=torch.float64), (0.02, 1.2)
_CONSTANT_NOISE, _CONSTANT_NOISE_PRIOR = torch.tensor([0.15, 0.25, 0.4, 0.7], dtype=torch.float32).double(), (0.2, 0.5)


class Posterior(NamedTuple):
    """This is what is known of one rig and of the detector that uses it."""

    mean: Tensor  # (12,) field coefficients (pixels), relative bias of the depth, setback (metres)
    covariance: Tensor  # (12, 12)
    depth_noise: float  # standard deviation of the detector's relative depth
    constant_noise_px: float


def solve_offsets(
    rows: Tensor,  # (N, 8) of `observe_detections`
    size_wh: tuple[int, int],
    focal_baseline: float,  # pixels x metres
    information: Tensor,  # (10, 10) of the field coefficients by other evidence
    vector: Tensor,  # (10,)
) -> Posterior:
    """Mean and covariance of all unknowns; without any evidence the priors give them."""
    u_v, d, offset, sigma = rows[:, :2], rows[:, 2], rows[:, 3], rows[:, 4]
    A = torch.cat([polynomial_basis(u_v, size_wh), d[:, None], d[:, None] ** 2 / focal_baseline], dim=1)
    grid = torch.meshgrid(_DEPTH_NOISE, _CONSTANT_NOISE, _FIELD_SCALES, indexing="ij")
    s, s0, scale = (x.reshape(-1) for x in grid)
    variance = (s[:, None] * d) ** 2 + s0[:, None] ** 2 + sigma**2
    own_sigma = torch.stack([_BIAS_OVER_NOISE * s, torch.full_like(s, _SETBACK_SIGMA_M)], dim=1)
    prior_sigma = torch.cat([scale[:, None] * by_degree(_FIELD_SIGMA_PX), own_sigma], dim=1)
    H_prior, b_prior = torch.diag_embed(1 / prior_sigma**2), torch.zeros_like(prior_sigma[0])
    H_prior[:, :NUM_COEFFICIENTS, :NUM_COEFFICIENTS] += information
    b_prior[:NUM_COEFFICIENTS] += vector
    by_size, its_sigma = _bias_by_size(rows[:, 7])
    H_prior[:, BIAS, BIAS] += 1 / its_sigma**2
    b_prior[BIAS] += by_size / its_sigma**2
    H, mean, likelihood = _student_t(A, offset, variance, H_prior, b_prior)
    of_noise = _log_prior(s, _DEPTH_NOISE_PRIOR) + _log_prior(s0, _CONSTANT_NOISE_PRIOR)
    share = (likelihood - prior_sigma.log().sum(dim=1) + of_noise).softmax(dim=0)
    overall = share @ mean
    apart = mean - overall
    covariance = (share[:, None, None] * (torch.linalg.inv(H) + apart[:, :, None] * apart[:, None])).sum(dim=0)
    return Posterior(overall, covariance, *(float((share @ x.log()).exp()) for x in (s, s0)))


def solve_rows(
    rows: Tensor,  # (N, 8)
    size_wh: tuple[int, int],
    information: Tensor,  # (10, 10)
    vector: Tensor,  # (10,)
) -> Tensor:  # (10,)
    """Coefficients of the row offsets, pixels."""
    variance = (rows[:, 6] ** 2 + _ROW_NOISE_PX**2)[None]
    basis = polynomial_basis(rows[:, :2], size_wh)
    H_prior = (torch.diag(1 / by_degree(_ROW_SIGMA_PX) ** 2) + information)[None]
    _, mean, _ = _student_t(basis, rows[:, 5], variance, H_prior, vector)
    return mean[0]


def _bias_by_size(size_error: Tensor) -> tuple[float, float]:
    """The detector's relative depth bias and its standard deviation by the size errors of masks (N,), 0 if unknown."""
    known = size_error[size_error != 0]
    if not len(known):
        return 0.0, math.inf
    return float(known.median()), math.hypot(_DIMENSIONS_SIGMA, _SIZE_SIGMA / math.sqrt(len(known)))


def _student_t(
    A: Tensor,  # (N, M)
    y: Tensor,  # (N,)
    variance: Tensor,  # (G, N)
    H_prior: Tensor,  # (G, M, M)
    b_prior: Tensor,  # (M,)
) -> tuple[Tensor, Tensor, Tensor]:
    """Solve reweighted least squares for G noises at once: H (G, M, M), mean (G, M), log evidence (G,)."""
    weight = torch.ones_like(variance)
    for _ in range(_NUM_ITERATIONS):
        weighted = (weight / variance)[..., None] * A
        H = weighted.mT @ A + H_prior
        mean = torch.linalg.solve(H, weighted.mT @ y + b_prior)
        squared = (y - mean @ A.T) ** 2 / variance
        weight = (_DEGREES_OF_FREEDOM + 1) / (_DEGREES_OF_FREEDOM + squared)
    per_point = variance.log() + (_DEGREES_OF_FREEDOM + 1) * torch.log1p(squared / _DEGREES_OF_FREEDOM)
    of_prior = ((mean[:, None] @ H_prior)[:, 0] * mean).sum(dim=1) - 2 * mean @ b_prior
    return H, mean, -0.5 * (per_point.sum(dim=1) + of_prior + torch.linalg.slogdet(H)[1])


def _log_prior(noise: Tensor, middle_and_spread: tuple[float, float]) -> Tensor:
    middle, spread = middle_and_spread
    return -0.5 * ((noise / middle).log() / spread) ** 2
