"""One damped Gauss-Newton step for every problem of a batch."""

from __future__ import annotations

import torch
from torch import Tensor

# Smallest diagonal entry that damping acts on, relative to the largest: directions that the data do not see at all
# are damped as well.
_RELATIVE_DIAGONAL_FLOOR = 1e-9


def damped_step(
    hessian: Tensor,  # (B, D, D) float64
    gradient: Tensor,  # (B, D)
    damping: Tensor,  # (B,) Marquardt's mu
) -> tuple[Tensor, Tensor]:
    """Solve `(H + mu diag(H)) step = -g` (Marquardt) by Cholesky.

    Returns:
        The steps (B, D), zero where there is none, and `solvable` (B,): false where the system is singular or not
        finite. Never raises and never synchronises with the device.

    Example:
        >>> step, solvable = damped_step(torch.eye(2)[None], torch.ones(1, 2), torch.zeros(1))
        >>> step
        tensor([[-1., -1.]])
    """
    diagonal = hessian.diagonal(dim1=-2, dim2=-1)
    floor = _RELATIVE_DIAGONAL_FLOOR * diagonal.amax(dim=-1, keepdim=True)
    damped = hessian + torch.diag_embed(damping[:, None] * torch.maximum(diagonal, floor))
    finite = damped.isfinite().all(dim=-1).all(dim=-1) & gradient.isfinite().all(dim=-1)
    identity = torch.eye(hessian.shape[-1], dtype=hessian.dtype, device=hessian.device)
    # Jacobi scaling: metres, radians and standard deviations differ by orders of magnitude in curvature.
    scale = torch.where(diagonal > 0, diagonal, torch.ones_like(diagonal)).rsqrt()
    scaled = torch.where(finite[:, None, None], scale[:, :, None] * damped * scale[:, None, :], identity)
    factor, info = torch.linalg.cholesky_ex(scaled)
    well_conditioned = factor.diagonal(dim1=-2, dim2=-1).amin(dim=-1) > 1e-7
    solvable = finite & (info == 0) & well_conditioned
    factor = torch.where(solvable[:, None, None], factor, identity)
    right = torch.where(solvable[:, None], -gradient * scale, torch.zeros_like(gradient))
    step = scale * torch.cholesky_solve(right[..., None], factor)[..., 0]
    return torch.where(solvable[:, None], step, torch.zeros_like(step)), solvable


def limit_step(
    step: Tensor,  # (B, D)
    limits: Tensor,  # (D,) largest trusted magnitude of each unknown
) -> Tensor:
    """The whole step scaled so that no unknown moves by more than its limit: direction is kept.

    Example:
        >>> limit_step(torch.tensor([[1.0, 4.0]]), torch.tensor([1.0, 1.0]))
        tensor([[0.2500, 1.0000]])
    """
    excess = (step.abs() / limits).amax(dim=-1, keepdim=True)
    return step / excess.clamp_min(1)
