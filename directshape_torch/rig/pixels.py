"""This module measures disparities at pixels of known depth and fits a rig's field to them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.geometry.disparity_field import EXPONENTS, NUM_COEFFICIENTS, polynomial_basis
from directshape_torch.rig.rig import Rig
from directshape_torch.stereo_matching.patch_alignment import MatchedPair

_GRID = (16, 8)
# A match farther from the truth than this is a wrong match or a hidden point, not a bias.
_LARGEST_DIFFERENCE_PX = 4.0
_POINTS_PER_FRAME = 30_000
# Points of one cell share their scene and its errors, and points of one frame also share the errors of the model.
# Therefore the points of a cell and of a frame count as at most these numbers of independent points.
_INDEPENDENT_PER_CELL = 10
_INDEPENDENT_PER_FRAME = 60
_NUM_ITERATIONS = 60
_TUKEY = 4.685
_SMALLEST_SCALE_PX = 0.02
# Aligned patches are accurate to 0.1 or 0.2 px. Wrong patches, on depth edges, err towards the nearer side by a pixel
# and more. Their spread must not become the scale by which they are judged, so the scale shrinks to the accuracy of
# patches.
_FIRST_ITERATIONS = 15
_SHRINK = 0.93
_PATCH_SCALE_PX = 0.15
_SMALLEST_NUMBER = 50
_TO_SIGMA = 1.4826  # sigma over the median absolute deviation
# These prior standard deviations of each degree are wide enough to leave the fit to the data, and keep it tame where
# there are few data.
COEFFICIENT_SIGMA_PX = (5.0, 2.0, 1.0, 0.5, 0.5)
_LARGEST_HULL = 24


class PixelEvidence(NamedTuple):
    """This is what pixels of known depth say of the coefficients of a field, in information form.

    The best coefficients of offsets and of rows both solve `H c = b`. The information `H` is the inverse of their
    covariance and `b` is the vector.
    """

    num_points: int
    num_frames: int
    information: Tensor  # (10, 10) 1/pixels^2
    vector: Tensor  # (10,) 1/pixels
    row_information: Tensor  # (10, 10)
    row_vector: Tensor  # (10,)
    hull_uv: Tensor  # (M, 2) convex polygon around the pixels

    def __add__(self, other: PixelEvidence) -> PixelEvidence:  # type: ignore[override]
        """Add two independent pieces of evidence."""
        sums = {name: getattr(self, name) + getattr(other, name) for name in self._fields[:-1]}
        return PixelEvidence(**sums, hull_uv=hull(torch.cat([self.hull_uv, other.hull_uv])))


def pixel_evidence(observations: Tensor, size_wh: tuple[int, int], num_frames: int = 1) -> PixelEvidence:
    """Fit the observations (P, 4) of `observe_disparity` by reweighted least squares (Tukey).

    All parts of the image count equally. Fewer than 50 observations raise `InputError`.
    """
    if len(observations) < _SMALLEST_NUMBER:
        raise InputError(
            "observations",
            f"at least {_SMALLEST_NUMBER} pixels of known and measured disparity",
            str(len(observations)),
            "give more frames, or check that calibration and ground truth belong to the images",
        )
    uv = observations[:, :2]
    basis, balance = polynomial_basis(uv, size_wh), _balance(uv, size_wh)
    of_field, of_rows = (_information(basis, offset, balance, num_frames) for offset in observations[:, 2:].T)
    return PixelEvidence(len(observations), num_frames, *of_field, *of_rows, hull(uv))


def hull(uv: Tensor) -> Tensor:  # (P, 2) -> (M, 2)
    """Convex polygon of at most 24 corners around pixels; it never extends beyond their convex hull."""
    import cv2

    corners = cv2.convexHull(uv.numpy().astype(np.float32))
    tolerance = 1.0
    while len(corners) > _LARGEST_HULL:
        corners = cv2.convexHull(cv2.approxPolyDP(corners, tolerance, closed=True))
        tolerance *= 1.5
    return torch.from_numpy(np.asarray(corners, dtype=np.float64).reshape(-1, 2))


def _information(
    basis: Tensor,  # (P, 10)
    offset_px: Tensor,  # (P,)
    balance: Tensor,  # (P,)
    num_frames: int,
) -> tuple[Tensor, Tensor]:
    """Fit by Tukey's biweight, starting from a constant field at the median.

    The scale shrinks from the spread of the residuals to the accuracy of the patches, because the outliers are
    one-sided.
    """
    sigma = by_degree(COEFFICIENT_SIGMA_PX)
    coefficients = torch.zeros(NUM_COEFFICIENTS, dtype=basis.dtype)
    coefficients[0] = offset_px.median()
    scale, weight = torch.zeros_like(sigma[0]), balance
    for iteration in range(_NUM_ITERATIONS):
        residual = offset_px - basis @ coefficients
        spread = (_TO_SIGMA * residual.abs().median()).clamp_min(_SMALLEST_SCALE_PX)
        shrunk = torch.minimum(scale, (_SHRINK * scale).clamp_min(_PATCH_SCALE_PX))
        scale = spread if iteration < _FIRST_ITERATIONS else shrunk
        weight = balance * tukey_weight(residual, scale)
        H = basis.T @ (weight[:, None] * basis) + torch.diag(scale**2 / sigma**2)
        coefficients = torch.linalg.solve(H, basis.T @ (weight * offset_px))
    share = (_INDEPENDENT_PER_FRAME * num_frames / weight.sum()).clamp_max(1.0) / scale.clamp_min(_PATCH_SCALE_PX) ** 2
    return share * basis.T @ (weight[:, None] * basis), share * basis.T @ (weight * offset_px)


def by_degree(sigma: tuple[float, ...]) -> Tensor:
    """Standard deviations (10,) of the coefficients, each from the entry of its degree."""
    return torch.tensor([sigma[i + j] for i, j in EXPONENTS], dtype=torch.float64)


def tukey_weight(distances: Tensor, scale: float | Tensor) -> Tensor:
    """Tukey's biweight (P,) in [0, 1] for residuals in standard deviations that are `scale` times too large."""
    return (1 - (distances / (_TUKEY * scale)) ** 2).clamp_min(0) ** 2


def _cell_index(uv: Tensor, size_wh: tuple[int, int]) -> Tensor:
    """Number (P,) of the image cell of each pixel (P, 2), row by row."""
    column = (uv[:, 0] * _GRID[0] / size_wh[0]).long().clamp(0, _GRID[0] - 1)
    row = (uv[:, 1] * _GRID[1] / size_wh[1]).long().clamp(0, _GRID[1] - 1)
    return row * _GRID[0] + column


def _balance(uv: Tensor, size_wh: tuple[int, int]) -> Tensor:
    """Weights (P,) that balance the parts of the image; without them the road, with most points, would dominate."""
    cell = _cell_index(uv, size_wh)
    count = torch.bincount(cell, minlength=_GRID[0] * _GRID[1]).double()
    return (_INDEPENDENT_PER_CELL / count[cell]).clamp_max(1.0)


def observe_disparity(
    pair: MatchedPair,
    rig: Rig,
    known: Tensor,  # (P, 3) u, v, depth
) -> Tensor:
    """Measure the disparity at pixels of known depth: semi-global matching, then alignment of small patches.

    Returns:
        (Q, 4) u, v, measured minus true disparity, measured minus true row in the right image, for points that both
        methods found. At most 30 000 pixels are taken, evenly over the image.
    """
    uv, displacement = known[:, :2], rig.displacement(known[:, :2], known[:, 2])
    last = torch.tensor(rig.size_wh) - 1
    column, row = torch.minimum(uv.round().long().clamp_min(0), last).unbind(dim=1)
    measured = pair.matched[row, column]
    # Comparisons with NaN are false, so unmatched pixels drop out here.
    usable = torch.nonzero((measured - displacement[:, 0]).abs() < _LARGEST_DIFFERENCE_PX)[:, 0]
    chosen = usable[_evenly(uv[usable], rig.size_wh, _POINTS_PER_FRAME)]
    uv, true = uv[chosen], displacement[chosen]
    # Patches are aligned because the semi-global disparity is biased towards whole pixels.
    found = pair.aligned(uv, measured[chosen], true[:, 1])
    offset = torch.stack([found.disparity - true[:, 0], true[:, 1] - found.row_shift], dim=1)
    keep = found.reliable & (offset[:, 0].abs() < _LARGEST_DIFFERENCE_PX)
    return torch.cat([uv, offset], dim=1)[keep]


def _evenly(uv: Tensor, size_wh: tuple[int, int], count: int) -> Tensor:
    """Indices of at most `count` pixels in ascending order; full cells are thinned first."""
    if len(uv) <= count:
        return torch.arange(len(uv))
    shuffled = torch.randperm(len(uv), generator=torch.Generator().manual_seed(0))
    cell = _cell_index(uv[shuffled], size_wh)
    by_cell = torch.argsort(cell, stable=True)
    rank_in_cell = torch.arange(len(uv)) - torch.searchsorted(cell[by_cell], cell[by_cell])
    first = torch.argsort(rank_in_cell, stable=True)[:count]
    return shuffled[by_cell[first]].sort().values
