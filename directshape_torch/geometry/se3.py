"""Rigid motions: exponential, logarithm, inverse, adjoint and generators of SE(3).

Twists are `(v, omega)`: metres, then radians, as in the paper's supplement (generators `G_0 .. G_5`).
All functions broadcast over leading dimensions, keep dtype and device, and have finite values and gradients
at the identity and near a rotation by pi.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.device_constants import made_once

# Below these squared angles trigonometric ratios are replaced by Taylor series, whose first terms left out are then
# below float64's rounding. Unlike the ratios they have finite derivatives of every order at zero.
_SMALL_ANGLE_SQUARED = 1e-3  # of the logarithm
_SERIES_ANGLE_SQUARED = 0.35  # of the exponential
# Coefficients of powers of -a^2, the highest first, of (1 - cos a)/a^2 and (a - sin a)/a^3.
_EXP_SERIES = tuple((1 / math.factorial(2 * n + 2), 1 / math.factorial(2 * n + 3)) for n in range(6, -1, -1))


def hat(vector: Tensor) -> Tensor:
    """Skew-symmetric matrix of a vector: `hat(a) @ b = a x b`.

    Args:
        vector: :math:`(*, 3)`.

    Returns:
        :math:`(*, 3, 3)`.

    Example:
        >>> hat(torch.tensor([0.0, 0.0, 1.0])) @ torch.tensor([1.0, 0.0, 0.0])
        tensor([0., 1., 0.])
    """
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    rows = (zero, -z, y, z, zero, -x, -y, x, zero)
    return torch.stack(rows, dim=-1).reshape(*vector.shape[:-1], 3, 3)


def generators(dtype: torch.dtype = torch.float64, device: torch.device | str | None = None) -> Tensor:
    """The six infinitesimal generators of SE(3), translations first (paper, supplement, `G_0 .. G_5`).

    Returns:
        :math:`(6, 4, 4)`.

    Example:
        >>> generators()[0, 0, 3]
        tensor(1., dtype=torch.float64)
    """
    basis = torch.zeros(6, 4, 4, dtype=dtype, device=device)
    identity = torch.eye(3, dtype=dtype, device=device)
    basis[:3, :3, 3] = identity
    basis[3:, :3, :3] = hat(identity)
    return basis


class _ExpConstants(NamedTuple):
    """What `exp` is made of."""

    part: Tensor  # (16,) of a twist that is, but for its sign, each entry of its matrix
    sign: Tensor  # (16,)
    identity: Tensor  # (4, 4)
    series: tuple[Tensor, ...]  # (2,) each


@made_once
def _exp_constants(dtype: torch.dtype, device: torch.device) -> _ExpConstants:
    series = torch.tensor(_EXP_SERIES, dtype=dtype, device=device).unbind(0)
    of_parts = generators(dtype, device).view(6, 16)
    part = of_parts.abs().argmax(dim=0)
    return _ExpConstants(part, of_parts.sum(dim=0), torch.eye(4, dtype=dtype, device=device), series)


def _exp_coefficients(angle_squared: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """`sin(a)/a`, `(1 - cos a)/a^2` and `(a - sin a)/a^3` as smooth functions of `a^2`."""
    b, c = _higher_exp_coefficients(angle_squared[..., None], math.inf).unbind(-1)
    return 1 - angle_squared * c, b, c


def _higher_exp_coefficients(angle_squared: Tensor, max_angle: float) -> Tensor:
    """The last two of `_exp_coefficients`, (*, 2) from (*, 1)."""
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


def exp(twist: Tensor, max_angle: float = math.inf) -> Tensor:
    """Exponential map of SE(3).

    Args:
        twist: :math:`(*, 6)`, `(v, omega)` in metres and radians.
        max_angle: no rotation is larger, radians. Where it is below 0.59 there are fewer operations, and a larger
            rotation would be wrong by its angle to the 16th power over 16!.

    Returns:
        Rigid transforms :math:`(*, 4, 4)`.

    Example:
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


def from_rotation_translation(R: Tensor, t: Tensor) -> Tensor:
    """Homogeneous transforms :math:`(*, 4, 4)` from rotations :math:`(*, 3, 3)` and translations :math:`(*, 3)`.

    Example:
        >>> from_rotation_translation(torch.eye(3), torch.ones(3))[:3, 3]
        tensor([1., 1., 1.])
    """
    top = torch.cat([R, t[..., None]], dim=-1)
    bottom = torch.eye(4, dtype=R.dtype, device=R.device)[3:].expand(*top.shape[:-2], 1, 4)
    return torch.cat([top, bottom], dim=-2)


def inverse(T: Tensor) -> Tensor:
    """Inverse of rigid transforms :math:`(*, 4, 4)`, by transposition of the rotation.

    Example:
        >>> T = exp(torch.tensor([1.0, 0.0, 0.0, 0.0, 0.5, 0.0]))
        >>> torch.allclose(inverse(T) @ T, torch.eye(4), atol=1e-6)
        True
    """
    R_transposed = T[..., :3, :3].transpose(-1, -2)
    return from_rotation_translation(R_transposed, -(R_transposed @ T[..., :3, 3:])[..., 0])


def transform(T_b_a: Tensor, points_a: Tensor) -> Tensor:
    """Points :math:`(*, 3)` in frame a moved to frame b by :math:`(*, 4, 4)`; leading dimensions broadcast.

    Example:
        >>> transform(exp(torch.tensor([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])), torch.zeros(5, 3)).shape
        torch.Size([5, 3])
    """
    return (T_b_a[..., :3, :3] @ points_a[..., None])[..., 0] + T_b_a[..., :3, 3]


def adjoint(T: Tensor) -> Tensor:
    """Adjoint :math:`(*, 6, 6)`: `T exp(d) T^-1 = exp(adjoint(T) d)`.

    Example:
        >>> adjoint(torch.eye(4)).shape
        torch.Size([6, 6])
    """
    R, t = T[..., :3, :3], T[..., :3, 3]
    top = torch.cat([R, hat(t) @ R], dim=-1)
    bottom = torch.cat([torch.zeros_like(R), R], dim=-1)
    return torch.cat([top, bottom], dim=-2)


def so3_log(R: Tensor) -> Tensor:
    """Rotation vector :math:`(*, 3)` of rotations :math:`(*, 3, 3)`, angle in :math:`[0, \\pi]`.

    Goes through the unit quaternion, whose largest component is always found stably: near pi the antisymmetric part
    of R vanishes and cannot give the axis.

    Example:
        >>> so3_log(torch.eye(3))
        tensor([0., 0., 0.])
    """
    w, xyz = _quaternion(R)
    sign = torch.where(w < 0, -torch.ones_like(w), torch.ones_like(w))
    w, xyz = w * sign, xyz * sign[..., None]
    s2 = (xyz * xyz).sum(-1)
    small = s2 < _SMALL_ANGLE_SQUARED
    safe = torch.where(small, torch.ones_like(s2), s2)
    s = safe.sqrt()
    # With x = |xyz| / w: 2 atan(x) / |xyz| = (2 / w) (1 - x^2/3 + x^4/5 - ...), a smooth function of |xyz|^2.
    w_safe = torch.where(small, w, torch.ones_like(w))
    q = torch.where(small, s2, torch.zeros_like(s2)) / (w_safe * w_safe)
    series = 2 / w_safe * (1 - q * (1 / 3 - q * (1 / 5 - q * (1 / 7 - q * (1 / 9 - q / 11)))))
    factor = torch.where(small, series, 2 * torch.atan2(s, torch.where(small, torch.ones_like(w), w)) / s)
    return factor[..., None] * xyz


def _quaternion(R: Tensor) -> tuple[Tensor, Tensor]:
    """Real part (*,) and vector part (*, 3) of the unit quaternion (either sign), from its largest component."""
    m = R
    trace = m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2]
    four_squared = torch.stack(
        [
            1 + trace,
            1 + 2 * m[..., 0, 0] - trace,
            1 + 2 * m[..., 1, 1] - trace,
            1 + 2 * m[..., 2, 2] - trace,
        ],
        dim=-1,
    )
    a, b, c = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    d, e, f = m[..., 1, 0] + m[..., 0, 1], m[..., 0, 2] + m[..., 2, 0], m[..., 2, 1] + m[..., 1, 2]
    # Row i is 4 q_i (w, x, y, z): each is proportional to the quaternion; the one with the largest q_i is stable.
    rows = torch.stack(
        [
            torch.stack([four_squared[..., 0], a, b, c], dim=-1),
            torch.stack([a, four_squared[..., 1], d, e], dim=-1),
            torch.stack([b, d, four_squared[..., 2], f], dim=-1),
            torch.stack([c, e, f, four_squared[..., 3]], dim=-1),
        ],
        dim=-2,
    )
    best = four_squared.argmax(dim=-1)[..., None, None].expand(*rows.shape[:-2], 1, 4)
    row = rows.gather(-2, best)[..., 0, :]
    q = row / row.norm(dim=-1, keepdim=True)
    return q[..., 0], q[..., 1:]


def log(T: Tensor) -> Tensor:
    """Twist :math:`(*, 6)` of rigid transforms :math:`(*, 4, 4)`, the inverse of `exp` for angles below pi.

    Example:
        >>> twist = torch.tensor([1.0, -2.0, 0.5, 0.1, 0.2, -0.3])
        >>> torch.allclose(log(exp(twist)), twist, atol=1e-5)
        True
    """
    omega = so3_log(T[..., :3, :3])
    t = (omega * omega).sum(-1)
    a, b, _ = _exp_coefficients(t)
    small = t < _SMALL_ANGLE_SQUARED
    safe = torch.where(small, torch.ones_like(t), t)
    # (1 - a / (2 b)) / angle^2, whose series at zero is 1/12 + t/720 + t^2/30240 + t^3/1209600.
    series = (1 + t / 60 * (1 + t / 42 * (1 + t / 40))) / 12
    d = torch.where(small, series, (1 - a / (2 * b)) / safe)
    W = hat(omega)
    V_inverse = torch.eye(3, dtype=T.dtype, device=T.device) - 0.5 * W + d[..., None, None] * (W @ W)
    return torch.cat([(V_inverse @ T[..., :3, 3:])[..., 0], omega], dim=-1)
