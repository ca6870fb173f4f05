"""This module holds rigid motions as matrices (*, 4, 4), and converts them to kornia's `Se3` and back.

Twists are `(v, omega)`: metres, then radians, as in the paper's supplement (generators `G_0 .. G_5`) and in kornia.
All functions broadcast over leading dimensions, keep dtype and device, and have finite values and gradients
at the identity and near a rotation by pi. The module has what a solver's step needs; kornia has logarithm and adjoint,
as in `to_kornia(T).log()`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from kornia.geometry.liegroup import Se3
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.numerics.full_precision import in_full_precision
from directshape_torch.numerics.tensors import made_once

# Below this squared angle trigonometric ratios are replaced by Taylor series, whose first omitted terms are then below
# float64's rounding. Unlike the ratios, the series have finite derivatives of every order at zero.
_SERIES_ANGLE_SQUARED = 0.35
# These are the coefficients of powers of -a^2, the highest first, in (1 - cos a)/a^2 and (a - sin a)/a^3.
EXP_SERIES = tuple((1 / math.factorial(2 * n + 2), 1 / math.factorial(2 * n + 3)) for n in range(6, -1, -1))


def generators(dtype: torch.dtype = torch.float64, device: torch.device | str | None = None) -> Tensor:
    """The six infinitesimal generators (6, 4, 4) of SE(3), translations first (paper, supplement, `G_0 .. G_5`)."""
    return Se3.hat(torch.eye(6, dtype=dtype, device=device))


class _ExpConstants(NamedTuple):
    """`_ExpConstants` are the tensors that `exp` combines a twist with."""

    part: Tensor  # (16,) index of the twist's component that each entry of the matrix is, up to its sign
    sign: Tensor  # (16,) sign of each entry
    identity: Tensor  # (4, 4)
    series: tuple[Tensor, ...]  # (2,) each, coefficients of the Taylor series


@made_once
def _exp_constants(dtype: torch.dtype, device: torch.device) -> _ExpConstants:
    series = torch.tensor(EXP_SERIES, dtype=dtype, device=device).unbind(0)
    of_parts = generators(dtype, device).view(6, 16)
    part = of_parts.abs().argmax(dim=0)
    return _ExpConstants(part, of_parts.sum(dim=0), torch.eye(4, dtype=dtype, device=device), series)


def _higher_exp_coefficients(angle_squared: Tensor, max_angle: float) -> Tensor:
    """`(1 - cos a)/a^2` and `(a - sin a)/a^3` (*, 2) as smooth functions of `a^2` (*, 1)."""
    minus_t = -angle_squared
    series, *lower = _exp_constants(minus_t).series
    for coefficients in lower:
        series = torch.addcmul(coefficients, series, minus_t)
    if max_angle**2 <= _SERIES_ANGLE_SQUARED:
        return series
    safe = angle_squared.clamp_min(_SERIES_ANGLE_SQUARED)
    angle = safe.sqrt()
    half = torch.sin(0.5 * angle)
    ratios = torch.cat([2 * half * half, 1 - torch.sin(angle) / angle], dim=-1) / safe
    return torch.where(angle_squared < _SERIES_ANGLE_SQUARED, series, ratios)


@in_full_precision
def exp(twist: Tensor, max_angle: float = math.inf) -> Tensor:
    """Exponential map of SE(3).

    Args:
        twist: :math:`(*, 6)`, `(v, omega)` in metres and radians.
        max_angle: bound of all rotations, radians. A bound below 0.59 saves operations, and a larger rotation would
            then be wrong by its angle to the 16th power over 16!.

    Returns:
        Rigid transforms :math:`(*, 4, 4)`.

    Examples:
        >>> exp(torch.tensor([1.0, 2.0, 3.0, 0.0, 0.0, 0.0]))[:3, 3]
        tensor([1., 2., 3.])
    """
    twists, constants = twist.reshape(-1, 6), _exp_constants(twist)
    omega = twists[:, 3:]
    coefficients = _higher_exp_coefficients((omega * omega).sum(dim=1, keepdim=True), max_angle)
    b, c = torch.split_with_sizes(coefficients[:, None], [1, 1], dim=2)
    X = (twists.index_select(1, constants.part) * constants.sign).view(-1, 4, 4)
    X2 = torch.bmm(X, X)
    # X^4 = -angle^2 X^2, hence the power series of the 4 x 4 matrix ends with its third power.
    T = torch.addcmul(constants.identity + X, b, X2).addcmul(c, torch.bmm(X2, X))
    return T.view(*twist.shape[:-1], 4, 4)


@in_full_precision
def from_rotation_translation(R: Tensor, t: Tensor) -> Tensor:
    """Homogeneous transforms :math:`(*, 4, 4)` from rotations :math:`(*, 3, 3)` and translations :math:`(*, 3)`.

    Examples:
        >>> from_rotation_translation(torch.eye(3), torch.ones(3))[:3, 3]
        tensor([1., 1., 1.])
    """
    top = torch.cat([R, t[..., None]], dim=-1)
    bottom = torch.eye(4, dtype=R.dtype, device=R.device)[3:].expand(*top.shape[:-2], 1, 4)
    return torch.cat([top, bottom], dim=-2)


@in_full_precision
def inverse(T: Tensor) -> Tensor:
    """Inverse of rigid transforms :math:`(*, 4, 4)`, by transposition of the rotation.

    Examples:
        >>> T = exp(torch.tensor([1.0, 0.0, 0.0, 0.0, 0.5, 0.0]))
        >>> torch.allclose(inverse(T) @ T, torch.eye(4), atol=1e-6)
        True
    """
    R_transposed = T[..., :3, :3].transpose(-1, -2)
    return from_rotation_translation(R_transposed, -(R_transposed @ T[..., :3, 3:])[..., 0])


@in_full_precision
def transform(T_b_a: Tensor, points_a: Tensor) -> Tensor:
    """Points :math:`(*, 3)` in frame a moved to frame b by :math:`(*, 4, 4)`; leading dimensions broadcast.

    Examples:
        >>> transform(exp(torch.tensor([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])), torch.zeros(5, 3)).shape
        torch.Size([5, 3])
    """
    return (T_b_a[..., :3, :3] @ points_a[..., None])[..., 0] + T_b_a[..., :3, 3]


def from_kornia(motion: Se3) -> Tensor:
    """Rigid transforms :math:`(*, 4, 4)` of kornia's `Se3`, say for `Detections.T_cam_obj`; metres.

    The result is differentiable. An `Se3` made of plain tensors holds parameters, and then its matrix asks for a
    gradient: detach it where none is wanted.

    Raises:
        InputError: the motion is no `Se3`.

    Examples:
        >>> from_kornia(Se3.trans_z(torch.tensor([20.0])))[0, :3, 3].detach()
        tensor([ 0.,  0., 20.])
    """
    if not isinstance(motion, Se3):
        raise InputError("motion", "kornia's Se3", type(motion).__name__, "matrices need no conversion")
    return motion.matrix()


@in_full_precision
def to_kornia(T: Tensor) -> Se3:
    """Rigid transforms :math:`(*, 4, 4)` as kornia's `Se3`, say of `RefinementResult.T_cam_obj`.

    Gradients flow through it to `T`; where `T` asks for none, neither do the parameters of the `Se3`.

    Raises:
        InputError: the shape is not :math:`(*, 4, 4)`.

    Examples:
        >>> T = exp(torch.tensor([[1.0, -2.0, 0.5, 0.1, 0.2, -0.3]]))
        >>> to_kornia(T).log()
        tensor([[ 1.0000, -2.0000,  0.5000,  0.1000,  0.2000, -0.3000]])
    """
    if T.shape[-2:] != (4, 4):
        raise InputError("T", "shape (*, 4, 4)", f"{tuple(T.shape)}", "build it with from_rotation_translation")
    # The matrix is copied, because the parameters of the `Se3` may be moved and trained.
    return Se3.from_matrix(T.clone()).requires_grad_(False)
