"""This module solves for the rig's unknowns given all evidence (docs/derivations/rig.md).

    measured - implied disparity = field(u, v) + bias d + setback d^2 / (f b) + noise

`d` is the measured disparity. The implied disparity contains the detector's error, and a regressor that shares the
noise of the offset would bias the fit. The noise is Student-t of variance `(s d)^2 + s0^2 + sigma^2`. The noises and
the scale of the field are summed over a grid, so that uncertainty about them widens the covariance. Where the height of
a mask implies the disparity, `size d + mask b / height` takes the place of `bias d`, and `s` is the spread of sizes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.geometry.disparity_field import NUM_COEFFICIENTS, polynomial_basis
from directshape_torch.rig.pixels import by_degree
from directshape_torch.rig.rig import Rig
from directshape_torch.start.rectangle_fit import MEAN_HWL

BIAS, SETBACK, SIZE, MASK = range(NUM_COEFFICIENTS, NUM_COEFFICIENTS + 4)

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
# The mean height of the cars of one place differs from that of KITTI's cars by this relative standard deviation, and
# the heights of single cars differ by the second one. All masks are too high or too low by so many pixels in common.
_MEAN_SIZE_SIGMA, _SIZE_NOISE, _MASK_SIGMA_PX = 0.04, 0.06, 0.25

_DEGREES_OF_FREEDOM = 4
_NUM_ITERATIONS = 30
# The grid holds standard deviations of a detector's relative depth, and of the noise in pixels that a perfect detector
# would leave. The prior of each is the middle and the spread of the logarithm over detectors from LiDAR to one camera.
_DEPTH_NOISE, _DEPTH_NOISE_PRIOR = torch.logspace(-2.7, -0.7, 15, dtype=torch.float64), (0.02, 1.2)
_CONSTANT_NOISE, _CONSTANT_NOISE_PRIOR = torch.tensor([0.15, 0.25, 0.4, 0.7], dtype=torch.float32).double(), (0.2, 0.5)


class Posterior(NamedTuple):
    """This is what is known of one rig and of the detector that uses it."""

    # (14,) field coefficients (pixels), relative bias of the depth, setback (metres), relative error of the mean size
    # of cars, error of the height of masks (pixels)
    mean: Tensor
    covariance: Tensor  # (14, 14)
    depth_noise: float  # standard deviation of the detector's relative depth
    constant_noise_px: float


def solve_offsets(
    rows: Tensor,  # (N, 8) of `observe_detections`
    sizes: Tensor,  # (M, 8) of `observe_sizes`
    rig: Rig,
    information: Tensor,  # (10, 10) of the field coefficients by other evidence
    vector: Tensor,  # (10,)
) -> Posterior:
    """Mean and covariance of all unknowns; without any evidence the priors give them."""
    cars = torch.cat([rows, sizes])
    d, offset, sigma = cars[:, 2], cars[:, 3], cars[:, 4]
    is_size, baseline = (torch.arange(len(cars)) >= len(rows)).double(), -rig.T_right_cam[0, 3]
    of_mask = is_size * baseline / MEAN_HWL[0]
    own = torch.stack([(1 - is_size) * d, d**2 / (rig.K_left[0, 0] * baseline), is_size * d, of_mask], dim=1)
    A = torch.cat([polynomial_basis(cars[:, :2], rig.size_wh), own], dim=1)
    grid = torch.meshgrid(_DEPTH_NOISE, _CONSTANT_NOISE, _FIELD_SCALES, indexing="ij")
    s, s0, scale = (x.reshape(-1) for x in grid)
    relative = torch.where(is_size > 0, _SIZE_NOISE, s[:, None])
    variance = (relative * d) ** 2 + s0[:, None] ** 2 + sigma**2
    common = s.new_tensor([_SETBACK_SIGMA_M, _MEAN_SIZE_SIGMA, _MASK_SIGMA_PX]).expand(len(s), 3)
    own_sigma = torch.cat([_BIAS_OVER_NOISE * s[:, None], common], dim=1)
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
