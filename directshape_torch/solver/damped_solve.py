"""This module solves linear systems of a batch, for damped and Newton steps, and never waits for the device."""

from __future__ import annotations

import torch
from torch import Tensor

# Damping acts on at least this share of the largest diagonal entry, so that directions that the data do not see at all
# are damped as well.
LEAST_DIAGONAL = 1e-9
# A system counts as singular below this pivot of its scaled factor, whose diagonal is 1 for independent unknowns.
LEAST_PIVOT = 1e-7


def damped_step(
    hessian: Tensor,  # (B, D, D) float64
    gradient: Tensor,  # (B, D)
    damping: Tensor,  # (B,) Marquardt's mu
) -> tuple[Tensor, Tensor]:
    """Solve `(H + mu diag(H)) step = -g` (Marquardt) by Cholesky, which reads the lower triangle of the symmetric H.

    It returns the steps (B, D), zero without a solution, and `solvable` (B,): false where the system is singular or not
    finite. It never raises and never synchronises with the device.
    """
    step, solvable = damped_solution(hessian, -gradient.unsqueeze(2), damping)
    return step.squeeze(2), solvable


def damped_solution(
    matrix: Tensor,  # (B, D, D) float64
    right: Tensor,  # (B, D, R)
    damping: Tensor,  # (B,)
) -> tuple[Tensor, Tensor]:
    """Solve `(M + mu diag(M)) X = right`; return X (B, D, R), zero where unsolvable, and where (B,) it is solvable."""
    # Jacobi scaling helps because metres, radians and standard deviations differ by orders of magnitude in curvature.
    # To a diagonal that is scaled to 1, damping adds mu itself.
    scale = floored_diagonal(matrix).rsqrt()
    identity = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
    scaled = torch.addcmul(matrix * scale.unsqueeze(2) * scale.unsqueeze(1), damping.view(-1, 1, 1), identity)
    factor, info = torch.linalg.cholesky_ex(scaled)
    # Numbers that are not finite end the factor early or make it NaN, and a comparison with NaN is false.
    regular = (factor.diagonal(dim1=1, dim2=2).amin(dim=1) > LEAST_PIVOT) & (info == 0)
    # A batch has no branches, so systems without a factor are solved with the identity and then dropped.
    factor = torch.where(regular.view(-1, 1, 1), factor, identity)
    solution = scale.unsqueeze(2) * torch.cholesky_solve(scale.unsqueeze(2) * right, factor)
    solvable = regular & is_finite(solution.sum(dim=(1, 2)))
    return torch.where(solvable.view(-1, 1, 1), solution, 0.0), solvable


def floored_diagonal(matrix: Tensor) -> Tensor:
    """The diagonal (B, D) that damping acts on, with a small share of its largest entry as least value."""
    diagonal = matrix.diagonal(dim1=1, dim2=2)
    return torch.maximum(diagonal, LEAST_DIAGONAL * diagonal.amax(dim=1, keepdim=True))


def is_finite(sums: Tensor) -> Tensor:
    """Where sums, and with them all terms, are finite; it takes two small operations where `isfinite` takes four."""
    zeros = sums - sums
    return torch.eq(zeros, zeros)


def step_size(
    step: Tensor,  # (B, D)
    limits: Tensor,  # (D,) largest trusted magnitude of each unknown
) -> Tensor:
    """The size (B,) of steps: the largest share of its limit by which an unknown moves.

    Examples:
        >>> step_size(torch.tensor([[0.1, 0.2]]), torch.tensor([1.0, 0.1]))
        tensor([2.])
    """
    return (step.abs() / limits).amax(dim=1)


def limit_step(
    step: Tensor,  # (B, D)
    size: Tensor,  # (B,) share of the limits, as `step_size` says
) -> Tensor:
    """The whole step scaled so that every unknown moves by its limit at most; the direction is kept.

    Examples:
        >>> limit_step(torch.tensor([[1.0, 4.0]]), torch.tensor([4.0]))
        tensor([[0.2500, 1.0000]])
    """
    return step / size.clamp_min(1).unsqueeze(1)


def newton_step(
    J: Tensor,  # (B, D, D) Jacobian of the gradient by the unknowns
    gradient: Tensor,  # (B, D)
) -> tuple[Tensor, Tensor]:
    """The steps (B, D) of `J step = -g`, zero where there is no solution, and where (B,) there is one.

    The steps are differentiable by the gradient alone.
    """
    J, right = J.detach(), -gradient.unsqueeze(2)
    info = torch.linalg.lu_factor_ex(J)[2]
    regular = (info == 0) & J.flatten(1).isfinite().all(dim=1)
    # Where there is no solution the system is replaced, so that no NaN passes into gradients.
    identity = torch.eye(J.shape[-1], dtype=J.dtype, device=J.device)
    is_regular = regular.view(-1, 1, 1)
    step = torch.linalg.solve(torch.where(is_regular, J, identity), torch.where(is_regular, right, 0.0))
    return step.squeeze(2), regular
