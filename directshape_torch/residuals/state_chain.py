"""The last factor of every chain: how a signed distance at a fixed depth of a ray depends on the state.

The state is moved by `delta = (v, omega, dcode)` with `T_obj_cam <- exp(delta[:6]) T_obj_cam`, so a point fixed in the
camera frame moves in the object frame by `v + omega x X` (paper, supplement, generators of SE(3)).
"""

from __future__ import annotations

import torch
from torch import Tensor

from directshape_torch.geometry.short_axes import cross
from directshape_torch.shape.shape_prior import SdfDerivatives


def sdf_state_jacobian(
    points_obj: Tensor,  # (P, 3) metres
    at: SdfDerivatives,
) -> Tensor:
    """`J_sdf_state = [grad, X x grad, basis]`, (P, 6 + K): per metre, per radian, per standard deviation.

    Example:
        >>> at = SdfDerivatives(torch.zeros(1), torch.tensor([[0.0, 1.0, 0.0]]), torch.zeros(1, 2))
        >>> sdf_state_jacobian(torch.tensor([[1.0, 0.0, 0.0]]), at)
        tensor([[0., 1., 0., 0., 0., 1., 0., 0.]])
    """
    return torch.cat([at.gradient, cross(points_obj, at.gradient), at.J_value_code], dim=-1)
