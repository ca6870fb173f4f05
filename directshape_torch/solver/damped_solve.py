"""Linear solves of a batch of problems, without a word to the host: the damped step, its limits, Newton's step."""

from __future__ import annotations

import torch
from torch import Tensor

# Smallest diagonal entry that damping acts on, relative to the largest: directions that the data do not see at all
# are damped as well.
_RELATIVE_DIAGONAL_FLOOR = 1e-9
# Of the scaled system's factor, whose diagonal is 1 where unknowns are independent.
_SMALLEST_PIVOT = 1e-7


def damped_step(
    hessian: Tensor,  # (B, D, D) float64
    gradient: Tensor,  # (B, D)
    damping: Tensor,  # (B,) Marquardt's mu
) -> tuple[Tensor, Tensor]:
    """Solve `(H + mu diag(H)) step = -g` (Marquardt) by Cholesky; of the symmetric H the lower triangle is read.

    Returns the steps (B, D), zero where there is none, and `solvable` (B,): false where the system is singular or not
    finite. Never raises and never synchronises with the device.
    """
    step, solvable = damped_solution(hessian, -gradient.unsqueeze(2), damping)
    return step.squeeze(2), solvable


def damped_solution(
    matrix: Tensor,  # (B, D, D) float64
    right: Tensor,  # (B, D, R)
    damping: Tensor,  # (B,)
) -> tuple[Tensor, Tensor]:
    """Solve `(M + mu diag(M)) X = right`, as `damped_step` does, for several columns: X (B, D, R), and where (B,)."""
    # Jacobi scaling: metres, radians and standard deviations differ by orders of magnitude in curvature. What is
    # scaled to 1 has the damping itself on its diagonal.
    scale = floored_diagonal(matrix).rsqrt()
    identity = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
    scaled = torch.addcmul(matrix * scale.unsqueeze(2) * scale.unsqueeze(1), damping.view(-1, 1, 1), identity)
    factor, info = torch.linalg.cholesky_ex(scaled)
    # Whatever is not finite makes the factor so, or ends it early: a comparison with NaN is false.
    regular = (factor.diagonal(dim1=1, dim2=2).amin(dim=1) > _SMALLEST_PIVOT) & (info == 0)
    # Solved all the same where there is no factor, for a batch has no branches, and then thrown away.
    factor = torch.where(regular.view(-1, 1, 1), factor, identity)
    solution = scale.unsqueeze(2) * torch.cholesky_solve(scale.unsqueeze(2) * right, factor)
    solvable = regular & is_finite(solution.sum(dim=(1, 2)))
    return torch.where(solvable.view(-1, 1, 1), solution, 0.0), solvable


def floored_diagonal(matrix: Tensor) -> Tensor:
    """What damping acts on (B, D): the diagonal, and a little of its largest entry where it is next to nothing."""
    diagonal = matrix.diagonal(dim1=1, dim2=2)
    return torch.maximum(diagonal, _RELATIVE_DIAGONAL_FLOOR * diagonal.amax(dim=1, keepdim=True))


def is_finite(sums: Tensor) -> Tensor:
    """Where sums are finite, and with them everything that was added: two small operations, `isfinite` is four."""
    zeros = sums - sums
    return torch.eq(zeros, zeros)


def step_size(
    step: Tensor,  # (B, D)
    limits: Tensor,  # (D,) largest trusted magnitude of each unknown
) -> Tensor:
    """How large steps are (B,), as a share of the limits: the largest of all unknowns.

    Examples:
        >>> step_size(torch.tensor([[0.1, 0.2]]), torch.tensor([1.0, 0.1]))
        tensor([2.])
    """
    return (step.abs() / limits).amax(dim=1)


def limit_step(
    step: Tensor,  # (B, D)
    size: Tensor,  # (B,) share of the limits, as `step_size` says
) -> Tensor:
    """The whole step scaled so that no unknown moves by more than its limit: direction is kept.

    Examples:
        >>> limit_step(torch.tensor([[1.0, 4.0]]), torch.tensor([4.0]))
        tensor([[0.2500, 1.0000]])
    """
    return step / size.clamp_min(1).unsqueeze(1)


def newton_step(
    J: Tensor,  # (B, D, D) of the gradient by the unknowns
    gradient: Tensor,  # (B, D)
) -> tuple[Tensor, Tensor]:
    """The steps (B, D) of `J step = -g`, zero where there is none, and where (B,) there is one.

    Differentiable by the gradient alone.
    """
    step, regular = general_solution(J.detach(), -gradient.unsqueeze(2))
    return step.squeeze(2), regular


def general_solution(
    matrix: Tensor,  # (B, D, D), of any kind
    right: Tensor,  # (B, D, R)
) -> tuple[Tensor, Tensor]:
    """Solve `M X = right`: X (B, D, R), zero where there is none, and where (B,) there is one."""
    info = torch.linalg.lu_factor_ex(matrix)[2]
    regular = (info == 0) & matrix.flatten(1).isfinite().all(dim=1)
    # Where there is no solution the system is replaced, so that no NaN passes into gradients.
    identity = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
    where = regular.view(-1, 1, 1)
    return torch.linalg.solve(torch.where(where, matrix, identity), torch.where(where, right, 0.0)), regular
