"""The residual disparity field of a rig from its own images alone, no LiDAR and no labels.

What the images show of the field, and what not:

- *A road at known height, single frames.* Pitch and roll of the road are unknown in every frame, and disparity on a
  plane is affine in the pixel: the field's constant and its slope along u are not seen at all, the slope along v as
  well as the height is known (1 cm of 1.65 m: 0.4 px between the horizon and the lower edge), higher degrees well.
- *Motion between frames* sees everything but a bias proportional to disparity, which is a wrong baseline.
- *Rows* are off visibly: the vertical part needs no depth.

So motion gives constant and slopes, the road and the camera's height what motion confuses with the length of the way.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.geometry.disparity_field import EXPONENTS, NUM_COEFFICIENTS, polynomial_basis
from directshape_torch.rig.disparity_observations import DisparityObservations, concatenate
from directshape_torch.rig.field_constraint import FieldConstraint, scale_of
from directshape_torch.rig.pixels import COEFFICIENT_SIGMA_PX, PixelEvidence, pixel_evidence

_NUM_ITERATIONS = 150
_FIRST_ITERATIONS = 10
_SHRINK = 0.85
_CONVERGED_PX = 1e-4
# A field less certain than this at its own data is that of the prior, not of the images.
_LARGEST_SIGMA_PX = 0.5
_LEAST_SIGMA_PX, _UNKNOWN_SIGMA_PX = 0.05, 0.2


@dataclass(frozen=True)
class SelfCalibration:
    """A field from images alone.

    Attributes:
        evidence: on the field, as sure at its data as the halves of the constraints agree.
        sigma_px: that standard deviation of the offset at the data, from how far the fields of the first and of the
            second half of the constraints are apart; what both share (height, baseline) is not in it. None where one
            of them alone determines no field: 0.2 px are taken then.
        converged: whether the last step was below 1e-4 px.
    """

    evidence: PixelEvidence
    sigma_px: float | None
    converged: bool


@dataclass(frozen=True)
class _Solution:
    """Coefficients (10,), their covariance (10, 10) were all constraints independent and the model true, the data."""

    coefficients: Tensor
    covariance: Tensor
    observations: DisparityObservations
    converged: bool

    def formal_sigma_px(self, size_wh: tuple[int, int]) -> float:
        """Of the bias at the data, median; too small by several times, but large where nothing is seen."""
        if len(self.observations) == 0:
            return math.inf
        basis = polynomial_basis(self.observations.uv_left, size_wh)
        return float(((basis @ self.covariance) * basis).sum(dim=-1).sqrt().median())


def self_calibrate(
    constraints: Sequence[FieldConstraint],
    size_wh: tuple[int, int],
    num_frames: int,
    on_step: Callable[[], object] | None = None,
) -> SelfCalibration:
    """The field that explains all constraints best: robust Gauss-Newton, each constraint's own unknowns eliminated.

    Args:
        constraints: `MotionConstraint` and `RoadConstraint` of many frames of one rig, in their order in time.
        size_wh: width and height of its images.
        num_frames: that the constraints are from.
        on_step: called after each step, to show progress.

    Raises:
        InputError: no constraints, or the field is not determined by them (road alone, or a car that stands).
    """
    solution = _solve(constraints, on_step)
    _check_determined(solution, size_wh)
    sigma_px = _sigma_from_halves(constraints, solution.observations.uv_left, size_wh, on_step)
    # What the covariance of independent points promises is several times less than what halves differ by.
    share = (solution.formal_sigma_px(size_wh) / max(sigma_px or _UNKNOWN_SIGMA_PX, _LEAST_SIGMA_PX)) ** 2
    information = min(share, 1.0) * torch.linalg.inv(solution.covariance)
    of_pixels = pixel_evidence(solution.observations, size_wh, num_frames)
    evidence = of_pixels._replace(information=information, vector=information @ solution.coefficients)
    return SelfCalibration(evidence, sigma_px, solution.converged)


def _solve(constraints: Sequence[FieldConstraint], on_step: Callable[[], object] | None) -> _Solution:
    current, scales = list(constraints), [5.0] * len(constraints)
    coefficients = torch.zeros(NUM_COEFFICIENTS, dtype=torch.float64)
    H, converged = _prior_information(), False
    for iteration in range(_NUM_ITERATIONS):
        linear = [c.linearise(coefficients, scale) for c, scale in zip(current, scales, strict=True)]
        parts = [one.of_field() for one in linear]
        H = _prior_information() + sum(part[0] for part in parts)
        g = _prior_information() @ coefficients + sum(part[1] for part in parts)
        step = -torch.linalg.solve(H, g)
        coefficients = coefficients + step
        current = [c.moved(one.own_step(step)) for c, one in zip(current, linear, strict=True)]
        spread = [scale_of(one.distances, c.degrees_of_freedom) for c, one in zip(current, linear, strict=True)]
        scales = [
            max(1.0, new if iteration < _FIRST_ITERATIONS else min(_SHRINK * old, new))
            for old, new in zip(scales, spread, strict=True)
        ]
        if on_step is not None:
            on_step()
        converged = iteration > _FIRST_ITERATIONS and float(step.abs().max()) < _CONVERGED_PX
        if converged:
            break
    observations = concatenate([c.observations(coefficients, s) for c, s in zip(current, scales, strict=True)])
    return _Solution(coefficients, torch.linalg.inv(H), observations, converged)


def _prior_information() -> Tensor:
    sigma = torch.tensor([COEFFICIENT_SIGMA_PX[i + j] for i, j in EXPONENTS], dtype=torch.float64)
    return torch.diag(1 / sigma**2)


def _sigma_from_halves(
    constraints: Sequence[FieldConstraint],
    uv_left: Tensor,  # (P, 2) pixels
    size_wh: tuple[int, int],
    on_step: Callable[[], object] | None,
) -> float | None:
    """Half of the RMS difference between the fields of two halves: the standard deviation of the halves' mean."""
    middle = len(constraints) // 2
    first, second = (_solve(part, on_step) for part in (constraints[:middle], constraints[middle:]))
    if max(first.formal_sigma_px(size_wh), second.formal_sigma_px(size_wh)) > _LARGEST_SIGMA_PX:
        return None
    difference = polynomial_basis(uv_left, size_wh) @ (first.coefficients - second.coefficients)
    return 0.5 * float(difference.square().mean().sqrt())


def _check_determined(solution: _Solution, size_wh: tuple[int, int]) -> None:
    cure = "give consecutive frames of a car that drives past still things (a road alone shows no constant, no slope)"
    if len(solution.observations) == 0:
        raise InputError("frames", "points that were followed from frame to frame", "none", cure)
    sigma_px = solution.formal_sigma_px(size_wh)
    if not sigma_px <= _LARGEST_SIGMA_PX:
        raise InputError(
            "frames", f"images that determine the field to {_LARGEST_SIGMA_PX} px", f"{sigma_px:.2g} px", cure
        )
