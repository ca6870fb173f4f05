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

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from directshape_torch.calibration.disparity_observations import DisparityObservations, concatenate
from directshape_torch.calibration.field_constraint import FieldConstraint, scale_of
from directshape_torch.calibration.fit_disparity_field import (
    COEFFICIENT_SIGMA_PX,
    FieldFit,
    build_field,
)
from directshape_torch.errors import InputError
from directshape_torch.geometry.disparity_field import EXPONENTS, NUM_COEFFICIENTS, polynomial_basis
from directshape_torch.scene import StereoCamera

_NUM_ITERATIONS = 40
_FIRST_ITERATIONS = 10
_SHRINK = 0.85
_CONVERGED_PX = 1e-4
# A field less certain than this at its own data is that of the prior, not of the images.
_LARGEST_SIGMA_PX = 0.5


@dataclass(frozen=True)
class SelfCalibration:
    """A field from images alone.

    Attributes:
        fit: field and statistics. `after` is measured against depths that were estimated together with the field.
        covariance: (10, 10) of the coefficients, pixels squared, for independent constraints.
        observations: disparities and rows against those depths, at the points that count.
    """

    fit: FieldFit
    covariance: Tensor
    observations: DisparityObservations

    def sigma(self, uv_left: Tensor) -> Tensor:
        """Standard deviation of the bias at left pixels (*, 2), pixels (*,); errors of the model not included."""
        return _sigma(self.covariance, uv_left, self.fit.field.size_wh)


def self_calibrate(
    constraints: Sequence[FieldConstraint],
    size_wh: tuple[int, int],
    camera: StereoCamera,
    frame_ids: tuple[str, ...] = (),
) -> SelfCalibration:
    """The field that explains all constraints best: robust Gauss-Newton, each constraint's own unknowns eliminated.

    Args:
        constraints: `MotionConstraint` and `RoadConstraint` of many frames of one rig.
        size_wh: width and height of its images.
        camera: its calibration.
        frame_ids: the frames; kept in the file.

    Raises:
        InputError: no constraints, or the field is not determined by them (road alone, or a car that stands).
    """
    current, scales = list(constraints), [5.0] * len(constraints)
    coefficients = torch.zeros(NUM_COEFFICIENTS, dtype=torch.float64)
    H = _prior_information()
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
        if iteration > _FIRST_ITERATIONS and float(step.abs().max()) < _CONVERGED_PX:
            break
    observations = concatenate([c.observations(coefficients, s) for c, s in zip(current, scales, strict=True)])
    covariance = torch.linalg.inv(H)
    _check_determined(covariance, observations, size_wh)
    fit = build_field(coefficients, observations, size_wh, camera, "motion", frame_ids)
    return SelfCalibration(fit, covariance, observations)


def _prior_information() -> Tensor:
    sigma = torch.tensor([COEFFICIENT_SIGMA_PX[i + j] for i, j in EXPONENTS], dtype=torch.float64)
    return torch.diag(1 / sigma**2)


def _sigma(covariance: Tensor, uv_left: Tensor, size_wh: tuple[int, int]) -> Tensor:
    basis = polynomial_basis(uv_left.double(), size_wh)
    return ((basis @ covariance) * basis).sum(dim=-1).sqrt()


def _check_determined(covariance: Tensor, observations: DisparityObservations, size_wh: tuple[int, int]) -> None:
    cure = "give consecutive frames of a car that drives past still things (a road alone shows no constant, no slope)"
    if len(observations) == 0:
        raise InputError("frames", "points that were followed from frame to frame", "none", cure)
    sigma = float(_sigma(covariance, observations.uv_left, size_wh).median())
    if not sigma <= _LARGEST_SIGMA_PX:
        raise InputError(
            "frames", f"images that determine the field to {_LARGEST_SIGMA_PX} px", f"{sigma:.2g} px", cure
        )
