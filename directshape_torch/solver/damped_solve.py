"""One damped Gauss-Newton step for every problem of a batch."""

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
    """Solve `(H + mu diag(H)) step = -g` (Marquardt) by Cholesky.

    Args:
        hessian: symmetric; the lower triangle is read.
        gradient, damping: see above.

    Returns:
        The steps (B, D), zero where there is none, and `solvable` (B,): false where the system is singular or not
        finite. Never raises and never synchronises with the device.

    Example:
        >>> step, solvable = damped_step(torch.eye(2)[None], torch.ones(1, 2), torch.zeros(1))
        >>> step
        tensor([[-1., -1.]])
    """
    diagonal = hessian.diagonal(dim1=1, dim2=2)
    floored = torch.maximum(diagonal, _RELATIVE_DIAGONAL_FLOOR * diagonal.amax(dim=1, keepdim=True))
    # Jacobi scaling: metres, radians and standard deviations differ by orders of magnitude in curvature. What is
    # scaled to 1 has the damping itself on its diagonal.
    scale = floored.rsqrt()
    identity = torch.eye(hessian.shape[-1], dtype=hessian.dtype, device=hessian.device)
    scaled = torch.addcmul(hessian * scale.unsqueeze(2) * scale.unsqueeze(1), damping.view(-1, 1, 1), identity)
    factor, info = torch.linalg.cholesky_ex(scaled)
    # Whatever is not finite makes the factor so, or ends it early: a comparison with NaN is false.
    regular = (factor.diagonal(dim1=1, dim2=2).amin(dim=1) > _SMALLEST_PIVOT) & (info == 0)
    # Solved all the same where there is no factor, for a batch has no branches, and then thrown away.
    factor = torch.where(regular.view(-1, 1, 1), factor, identity)
    step = scale * torch.cholesky_solve((scale * -gradient).unsqueeze(2), factor).squeeze(2)
    solvable = regular & is_finite(step.sum(dim=1))
    return torch.where(solvable.unsqueeze(1), step, 0.0), solvable


def step_lengths(stretched: Tensor, over_relaxation: float) -> Tensor:
    """What steps are multiplied by: `over_relaxation` where they are to be longer, else 1.

    The Gauss-Newton matrix of a reweighted residual (IRLS) usually overestimates its curvature, so that plain steps
    approach the minimum from one side, a share of the way at a time. Longer ones save iterations, and below a factor of
    2 a quadratic energy still falls. The solver stretches the first step of a stage and each that follows one that
    paid. Else the next one is plain, and more damped where the longer one was refused; if that promises and brings next
    to nothing, the problem has settled.

    Args:
        stretched: (B,) bool, which steps are to be longer.
        over_relaxation: from 1 to below 2.

    Returns:
        Factors (B,), of the default type.

    Example:
        >>> step_lengths(torch.tensor([True, False]), 1.5)
        tensor([1.5000, 1.0000])
    """
    return torch.where(stretched, over_relaxation, 1.0)


def is_finite(sums: Tensor) -> Tensor:
    """Where sums are finite, and with them everything that was added: two small operations, `isfinite` is four.

    Example:
        >>> is_finite(torch.tensor([1.0, torch.inf, torch.nan]))
        tensor([ True, False, False])
    """
    zeros = sums - sums
    return torch.eq(zeros, zeros)


def limit_step(
    step: Tensor,  # (B, D)
    limits: Tensor,  # (D,) largest trusted magnitude of each unknown
) -> Tensor:
    """The whole step scaled so that no unknown moves by more than its limit: direction is kept.

    Example:
        >>> limit_step(torch.tensor([[1.0, 4.0]]), torch.tensor([1.0, 1.0]))
        tensor([[0.2500, 1.0000]])
    """
    return limited_step(step, limits)[0]


def limited_step(step: Tensor, limits: Tensor) -> tuple[Tensor, Tensor]:
    """`limit_step`, and the size (B,) of what it returns as a share of the limits, at most 1.

    Example:
        >>> limited_step(torch.tensor([[0.1, 0.2]]), torch.tensor([1.0, 1.0]))[1]
        tensor([0.2000])
    """
    size = (step.abs() / limits).amax(dim=1)
    return step / size.clamp_min(1).unsqueeze(1), size.clamp_max(1)
