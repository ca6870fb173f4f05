"""How well a prior of any kind can take on known cars, also those that it was not made from."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.numerics.checks import check_shape
from directshape_torch.shape.mesh_to_sdf import GridSpec
from directshape_torch.shape.pca_fit import fit_pca
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.shape.shape_prior import ShapePrior

NEAR_SURFACE_M = 0.07
_ITERATIONS, _LARGEST_CODE, _CONVERGED = 12, 3.0, 1e-5
# Of the mean squared derivative: codes that hardly change the surface stay small.
_RIDGE = 1e-4


@dataclass(frozen=True)
class FittedCar:
    """A known car and the shape of a prior that is nearest to it."""

    name: str  # of the car
    truth: Tensor  # (nx, ny, nz) its signed distance on the prior's grid, metres
    values: Tensor  # (nx, ny, nz) that of the prior's shape
    code: Tensor  # (K,) of that shape
    error_cm: float  # mean |difference| over the nodes within 7 cm of the true surface


def grid_of(prior: ShapePrior) -> GridSpec:
    """The grid on which a prior's surfaces are measured.

    Examples:
        >>> from directshape_torch.shape.pca_prior import PCAShapePrior
        >>> grid_of(PCAShapePrior.load_bundled()).shape
        (59, 26, 27)
    """
    nx, ny, nz = prior.values(prior.initial_code(1)).shape[1:]
    x, y, z = prior.origin.double().tolist()
    return GridSpec((x, y, z), prior.spacing_m, (nx, ny, nz))


@torch.no_grad()
def fit_car(prior: ShapePrior, truth: Tensor, name: str = "") -> FittedCar:
    """Fit the code alone by damped Gauss-Newton to the nodes near the true surface; |code| is at most 3.

    Args:
        prior: on the CPU.
        truth: (nx, ny, nz) signed distance at the nodes of `grid_of(prior)`, metres.
        name: for titles.

    Raises:
        InputError: another grid, or fewer nodes near a surface than the prior has components.
    """
    grid = grid_of(prior)
    check_shape("truth", truth, grid.shape, "sample it at the prior's own nodes")
    near = truth.abs() <= NEAR_SURFACE_M
    if int(near.sum()) < prior.num_codes:
        raise InputError("truth", f"at least {prior.num_codes} nodes near the surface", f"{int(near.sum())}")
    points = torch.from_numpy(grid.nodes()).to(prior.origin)[near]
    wanted, index = truth[near].to(prior.origin), torch.zeros(len(points), dtype=torch.long)
    code = prior.initial_code(1)
    best, cost_of_best = code, torch.inf
    for _ in range(_ITERATIONS):
        at = prior.bind(code).value_and_derivatives(points, index)
        difference = at.value - wanted
        cost = float(difference.square().sum())
        if cost < cost_of_best:
            best, cost_of_best = code, cost
        H = at.J_value_code.mT @ at.J_value_code
        H = H + _RIDGE * torch.diag(H.diag())
        step = torch.linalg.solve(H, at.J_value_code.mT @ difference)
        code = (code - step).clamp(-_LARGEST_CODE, _LARGEST_CODE)
        if bool((code - best).abs().max() < _CONVERGED):
            break
    values = prior.values(best)[0]
    return FittedCar(name, truth, values, best[0], 100 * float((values - truth)[near].abs().mean()))


def leave_one_out_errors_cm(
    sdf_samples: Tensor,  # (N, nx, ny, nz)
    prior: PCAShapePrior,
    most: int = 60,
) -> Tensor:  # (min(N, most),)
    """Error of `fit_car` for samples that a prior made of all others was fitted to, centimetres.

    With more samples than `most`, that many evenly spaced ones are left out in turn.

    Raises:
        InputError: fewer than three samples.
    """
    count = len(sdf_samples)
    if count < 3:
        raise InputError("sdf_samples", "at least 3 samples", f"{count}")
    left_out = torch.linspace(0, count - 1, min(count, most)).round().long().tolist()
    num_codes = min(prior.num_codes, count - 2)
    errors = []
    for k in left_out:
        others = torch.cat([sdf_samples[:k], sdf_samples[k + 1 :]])
        prior_of_others = fit_pca(others, prior.origin, prior.spacing_m, num_codes, prior.provenance)
        errors.append(fit_car(prior_of_others, sdf_samples[k]).error_cm)
    return torch.tensor(errors, dtype=torch.float64)
