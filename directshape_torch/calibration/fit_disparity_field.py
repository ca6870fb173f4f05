"""Robust fit of a rig's residual disparity field to measured against true disparities."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from directshape_torch.calibration.disparity_observations import DisparityObservations, cell_index
from directshape_torch.errors import InputError
from directshape_torch.geometry.disparity_field import EXPONENTS, DisparityField, polynomial_basis
from directshape_torch.scene import StereoCamera

COVERAGE_GRID = (8, 4)
_POINTS_TO_COVER_CELL = 5
_BALANCE_GRID = (16, 8)
# Points of one cell share their scene and its errors: they count as this many independent ones at most.
_INDEPENDENT_PER_CELL = 10
_NUM_ITERATIONS = 60
_TUKEY = 4.685
_SMALLEST_SCALE_PX = 0.02
# Aligned patches are good to a tenth of a pixel or two. Wrong ones, on depth edges, err towards the nearer side by a
# pixel and more: their spread must not become the scale by which they are judged, so it shrinks to the patches' own.
_FIRST_ITERATIONS = 15
_SHRINK = 0.93
_PATCH_SCALE_PX = 0.15
_SMALLEST_NUMBER = 50
# Standard deviation expected of a coefficient by its degree, pixels: what keeps the fit tame where data is thin.
COEFFICIENT_SIGMA_PX = (5.0, 2.0, 1.0, 0.5, 0.5)
_LARGEST_HULL = 24


@dataclass(frozen=True)
class FitStatistics:
    """How the measured disparity differs from the true one, before and after the field is taken off.

    Attributes:
        num_points: observations used.
        median_before_px, mad_before_px: median and median absolute deviation of measured minus true.
        median_after_px, mad_after_px: the same with the field taken off.
        uncovered_cells: (row, column), from 0, of the cells of an 8 x 4 grid with fewer than 5 observations.
    """

    num_points: int
    median_before_px: float
    mad_before_px: float
    median_after_px: float
    mad_after_px: float
    uncovered_cells: tuple[tuple[int, int], ...]

    @property
    def uncovered_share(self) -> float:
        """Share of the image's 32 cells without data."""
        return len(self.uncovered_cells) / (COVERAGE_GRID[0] * COVERAGE_GRID[1])


@dataclass(frozen=True)
class FieldFit:
    """A fitted field and how good it is."""

    field: DisparityField
    statistics: FitStatistics


def fit_disparity_field(
    observations: DisparityObservations,
    size_wh: tuple[int, int],
    camera: StereoCamera,
    source: str,
    frame_ids: tuple[str, ...] = (),
) -> FieldFit:
    """Fit the polynomial by reweighted least squares (Tukey), each part of the image counting alike, with a ridge.

    Args:
        observations: of one or several frames of the rig.
        size_wh: width and height of its images.
        camera: its calibration (the first frame is taken).
        source: where the true disparities came from; kept in the file.
        frame_ids: the frames; kept in the file.

    Raises:
        InputError: fewer than 50 observations.
    """
    if len(observations) < _SMALLEST_NUMBER:
        raise InputError(
            "observations",
            f"at least {_SMALLEST_NUMBER} pixels of known and measured disparity",
            str(len(observations)),
            "give more frames, or check that calibration and ground truth belong to the images",
        )
    balance = _balance(observations.uv_left, size_wh)
    coefficients = _robust_ridge(polynomial_basis(observations.uv_left, size_wh), observations.bias_px, balance)
    return build_field(coefficients, observations, size_wh, camera, source, frame_ids)


def build_field(
    coefficients: Tensor,  # (10,) pixels
    observations: DisparityObservations,
    size_wh: tuple[int, int],
    camera: StereoCamera,
    source: str,
    frame_ids: tuple[str, ...] = (),
) -> FieldFit:
    """A field of given coefficients; rows, hull and statistics from the observations (arguments as above)."""
    basis = polynomial_basis(observations.uv_left, size_wh)
    before, after = observations.bias_px, observations.bias_px - basis @ coefficients
    statistics = FitStatistics(
        len(observations), *_median_and_mad(before), *_median_and_mad(after), _uncovered(observations.uv_left, size_wh)
    )
    balance = _balance(observations.uv_left, size_wh)
    field = DisparityField(
        coefficients=coefficients,
        vertical_coefficients=_robust_ridge(basis, observations.vertical_px, balance),
        hull_uv=_hull(observations.uv_left),
        size_wh=size_wh,
        K_left=camera.K_left[0].double().cpu(),
        K_right=camera.K_right[0].double().cpu(),
        T_right_cam=camera.T_right_cam[0].double().cpu(),
        provenance=_provenance(statistics, source, frame_ids),
    )
    return FieldFit(field, statistics)


def _provenance(statistics: FitStatistics, source: str, frame_ids: tuple[str, ...]) -> dict[str, str | int | float]:
    numbers = {name: value for name, value in vars(statistics).items() if name != "uncovered_cells"}
    uncovered = round(statistics.uncovered_share, 4)
    return {"source": source, "frames": " ".join(frame_ids), **numbers, "uncovered_share": uncovered}


def _robust_ridge(
    basis: Tensor,  # (P, 10)
    bias_px: Tensor,  # (P,)
    weight: Tensor,  # (P,)
) -> Tensor:  # (10,)
    """Tukey's biweight from a start that is the median alone; its scale shrinks from the residuals' spread to the
    accuracy of the patches, because the outliers are one-sided."""
    sigma = torch.tensor([COEFFICIENT_SIGMA_PX[i + j] for i, j in EXPONENTS], dtype=basis.dtype)
    coefficients = torch.zeros_like(sigma)
    coefficients[0] = bias_px.median()
    scale = torch.zeros_like(sigma[0])
    for iteration in range(_NUM_ITERATIONS):
        residual = bias_px - basis @ coefficients
        spread = (1.4826 * residual.abs().median()).clamp_min(_SMALLEST_SCALE_PX)
        shrunk = torch.minimum(scale, (_SHRINK * scale).clamp_min(_PATCH_SCALE_PX))
        scale = spread if iteration < _FIRST_ITERATIONS else shrunk
        robust = (1 - (residual / (_TUKEY * scale)) ** 2).clamp_min(0) ** 2
        weighted = basis * (weight * robust)[:, None]
        H = weighted.T @ basis + torch.diag(scale**2 / sigma**2)
        coefficients = torch.linalg.solve(H, weighted.T @ bias_px)
    return coefficients


def _balance(uv: Tensor, size_wh: tuple[int, int]) -> Tensor:
    """Weights that let no part of the image outvote another, as the road would, which has most of the points."""
    cell = cell_index(uv, size_wh, _BALANCE_GRID)
    count = torch.bincount(cell, minlength=_BALANCE_GRID[0] * _BALANCE_GRID[1]).double()
    return (_INDEPENDENT_PER_CELL / count[cell]).clamp_max(1.0)


def _median_and_mad(values: Tensor) -> tuple[float, float]:
    median = values.median()
    return float(median), float((values - median).abs().median())


def _uncovered(uv: Tensor, size_wh: tuple[int, int]) -> tuple[tuple[int, int], ...]:
    columns, rows = COVERAGE_GRID
    count = torch.bincount(cell_index(uv, size_wh, COVERAGE_GRID), minlength=columns * rows)
    empty = torch.nonzero(count < _POINTS_TO_COVER_CELL)[:, 0].tolist()
    return tuple((cell // columns, cell % columns) for cell in empty)


def _hull(uv: Tensor) -> Tensor:
    """Convex polygon of few corners round the data, never beyond it."""
    import cv2

    corners = cv2.convexHull(uv.numpy().astype(np.float32))
    tolerance = 1.0
    while len(corners) > _LARGEST_HULL:
        corners = cv2.convexHull(cv2.approxPolyDP(corners, tolerance, closed=True))
        tolerance *= 1.5
    return torch.from_numpy(np.asarray(corners, dtype=np.float64).reshape(-1, 2))
