"""Common to what constrains a field: normal equations with unknowns of their own, which are eliminated."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol, Self

import torch
from torch import Tensor

from directshape_torch.geometry.camera import rays_from_pixels
from directshape_torch.geometry.disparity_field import NUM_COEFFICIENTS
from directshape_torch.rig.disparity_observations import DisparityObservations

# Standard deviation of a patch's disparity, pixels.
PATCH_SIGMA_PX = 0.12
_TUKEY = 4.685
# Points of one frame share their scene, its errors and those of the model: they count as so many independent ones.
_INDEPENDENT_POINTS = 60


@dataclass(frozen=True)
class Linearisation:
    """Normal equations of one constraint: its own M unknowns first, then the field's coefficients.

    Attributes:
        H: (M + 10, M + 10), g: (M + 10,), `H delta = -g`.
        distances: (P,) residual of each point in standard deviations.
    """

    H: Tensor
    g: Tensor
    distances: Tensor

    def of_field(self) -> tuple[Tensor, Tensor]:
        """H (10, 10) and g (10,) of the coefficients with the other unknowns eliminated."""
        M = len(self.g) - NUM_COEFFICIENTS
        solved = self._solved()
        return self.H[M:, M:] - self.H[M:, :M] @ solved[:, 1:], self.g[M:] - self.H[M:, :M] @ solved[:, 0]

    def own_step(self, step: Tensor) -> Tensor:
        """Step (M,) of the constraint's own unknowns that belongs to a step (10,) of the coefficients."""
        solved = self._solved()
        moved: Tensor = -(solved[:, 0] + solved[:, 1:] @ step)
        return moved

    def _solved(self) -> Tensor:
        M = len(self.g) - NUM_COEFFICIENTS
        own = self.H[:M, :M]
        # A direction of its own unknowns that nothing sees (a bend of the road) stays where it is.
        own = own + torch.diag(1e-9 * own.diagonal() + 1e-12)
        solved: Tensor = torch.linalg.solve(own, torch.cat([self.g[:M, None], self.H[:M, M:]], dim=1))
        return solved


class FieldConstraint(Protocol):
    """Something seen in the images that the field has to explain."""

    @property
    def degrees_of_freedom(self) -> int:
        """Dimensions of a point's residual: two or one."""
        ...

    def linearise(self, coefficients: Tensor, scale: float) -> Linearisation:
        """At the coefficients (10,) and its own state; `scale`: of the residuals, in standard deviations."""
        ...

    def moved(self, own_step: Tensor) -> Self:
        """With its own unknowns changed."""
        ...

    def observations(self, coefficients: Tensor, scale: float) -> DisparityObservations:
        """Disparity and row against those of its own state, at the points that count."""
        ...


def tukey_weight(distances: Tensor, scale: float) -> Tensor:
    """Tukey's biweight, (P,) in [0, 1], for residuals in standard deviations that are `scale` times too large."""
    return (1 - (distances / (_TUKEY * scale)) ** 2).clamp_min(0) ** 2


def information_share(weight: Tensor, scale: float) -> Tensor:
    """By what the points' normal equations are multiplied so that all together count as 60 independent ones at most."""
    return (_INDEPENDENT_POINTS / weight.sum().clamp_min(1e-9)).clamp_max(1.0) / scale**2


def scale_of(distances: Tensor, degrees_of_freedom: int) -> float:
    """How many times larger than expected residuals are, by their median (of one or two dimensions)."""
    if len(distances) == 0:
        return 1.0
    expected = 0.6745 if degrees_of_freedom == 1 else math.sqrt(2 * math.log(2))
    return float(distances.median()) / expected


def disparity_slope(
    uv_left: Tensor,  # (P, 2) pixels
    inverse_depth: Tensor,  # (P,) 1/m
    K_left: Tensor,  # (3, 3)
    K_right: Tensor,  # (3, 3)
    T_right_cam: Tensor,  # (4, 4)
) -> Tensor:  # (P,)
    """Derivative of the true disparity by the inverse depth, pixels x metres.

    Examples:
        >>> K, T = torch.tensor([[700.0, 0, 600], [0, 700, 180], [0, 0, 1]]), torch.eye(4)
        >>> T[0, 3] = -0.5
        >>> disparity_slope(torch.tensor([[600.0, 180.0]]), torch.tensor([0.1]), K, K, T)
        tensor([350.])
    """
    a = rays_from_pixels(uv_left, K_left) @ (K_right @ T_right_cam[:3, :3]).T
    b = K_right @ T_right_cam[:3, 3]
    homogeneous = a + inverse_depth[:, None] * b
    u_right = homogeneous[:, 0] / homogeneous[:, 2]
    return -(b[0] - u_right * b[2]) / homogeneous[:, 2]
