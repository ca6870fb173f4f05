"""Residuals of one car pixel by pixel at one of its states, as the terms of the final stage count them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.energy.car_problem import CarProblem
from directshape_torch.energy.car_state import CarState
from directshape_torch.energy.photometric_term import PhotometricTerm
from directshape_torch.energy.silhouette_term import SilhouetteTerm
from directshape_torch.observation.occlusion import Side
from directshape_torch.photometric_match import stage_pixels
from directshape_torch.refinement_trace import RefinementTrace


class PixelResiduals(NamedTuple):
    """P pixels of one car with what the cost says of them."""

    uv: NDArray[np.float64]  # (P, 2) full-resolution pixels
    value: NDArray[np.float64]  # (P,)
    lost: NDArray[np.bool_]  # (P,) there is nothing to compare, and the pixel pays a constant


_NOTHING = PixelResiduals(np.zeros((0, 2)), np.zeros(0), np.zeros(0, dtype=np.bool_))


def problem_of_car(trace: RefinementTrace, car: int) -> CarProblem:
    """The final stage's problem of one car that took part."""
    return trace.problem.compact(trace.rows == car)


@torch.no_grad()
def silhouette_residuals(trace: RefinementTrace, car: int, number: int, side: Side) -> PixelResiduals:
    """`-log` of the probability of each sampled pixel's mask, for state `number` of the trace.

    Nothing is lost: a ray that passes the shape by says so. No pixels where there is no such term.
    """
    problem = problem_of_car(trace, car)
    projected = problem.project(_state(trace, car, number))
    for term in problem.terms:
        if isinstance(term, SilhouetteTerm) and term.side == side:
            values = _array(term.pixel_residual(projected))
            return PixelResiduals(_array(term.pixels.uv), values, np.zeros(len(values), dtype=np.bool_))
    return _NOTHING


@torch.no_grad()
def photometric_residuals(trace: RefinementTrace, car: int, number: int) -> PixelResiduals:
    """Right image less left image, in grey levels, averaged over the part of each neighbourhood that is on the car.

    Pixels that have no surface under them, leave the right image or are hidden there are lost.
    """
    problem = problem_of_car(trace, car)
    projected = problem.project(_state(trace, car, number))
    for term in problem.terms:
        if isinstance(term, PhotometricTerm):
            fixed, (usable, residual) = stage_pixels(term), term.values(projected)
            weight = fixed.neighbour_weight
            mean = (residual * weight).sum(dim=1) / weight.sum(dim=1).clamp_min(1)
            uv = term.pixels.uv[fixed.pixel_index]
            return PixelResiduals(_array(uv), _array(mean), np.asarray(~usable.cpu()))
    return _NOTHING


def _state(trace: RefinementTrace, car: int, number: int) -> CarState:
    state = trace.states[number]
    return CarState(*(x[car : car + 1] for x in state))


def _array(values: Tensor) -> NDArray[np.float64]:
    return np.asarray(values.double().cpu())
