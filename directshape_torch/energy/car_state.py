"""State of B cars and the one place where it is updated."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.geometry import se3


class CarState(NamedTuple):
    """Pose and shape of B cars."""

    T_obj_cam: Tensor  # (B, 4, 4) left camera to object
    code: Tensor  # (B, K) standard deviations


def retract(state: CarState, delta: Tensor, max_code: float = torch.inf, max_angle: float = torch.inf) -> CarState:
    """`T_obj_cam <- exp(delta[:6]) T_obj_cam`, `code <- code + delta[6:]`, the code bounded.

    Args:
        state: B cars.
        delta: (B, 6 + K), `(v, omega, dcode)` in metres, radians and standard deviations.
        max_code: largest magnitude of a code component.
        max_angle: no rotation is larger, radians (see `se3.exp`).

    Example:
        >>> state = CarState(torch.eye(4)[None], torch.zeros(1, 2))
        >>> retract(state, torch.tensor([[1.0, 0, 0, 0, 0, 0, 0.5, 9.0]]), max_code=3.0).code
        tensor([[0.5000, 3.0000]])
    """
    twist, code_step = torch.split_with_sizes(delta.to(state.code.dtype), [6, delta.shape[1] - 6], dim=1)
    T_obj_cam = torch.bmm(se3.exp(twist, max_angle), state.T_obj_cam)
    return CarState(T_obj_cam, (state.code + code_step).clamp(-max_code, max_code))
