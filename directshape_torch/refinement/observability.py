"""This module tells, from the Fisher information at the end, which directions a view does not show."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import torch
from torch import Tensor

from directshape_torch.geometry import se3
from directshape_torch.geometry.box3d import alpha_from_kitti, rotation_y_from_pose, viewing_axes
from directshape_torch.numerics.records import CarRecord, Dense
from directshape_torch.numerics.tensors import constant_like
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.state.unknowns import State

CAR_QUANTITIES = ("depth", "sideways position", "height above ground", "heading", "length", "width", "height")
"""These are the seven quantities that a direction is made of, all in metres.

The depth is the distance from the camera along the ground. The sideways position grows to the camera's right. The
heading counts as the way that the car's end moves when the car turns: radians times `HEADING_LEVER_M`.
"""

HEADING_LEVER_M = 2.0
"""This is half the length of a typical car."""

# Parts of a direction below this share of its largest part are not named.
_NAMED_SHARE = 0.2
# An unknown that the images do not show at all would have an infinite sigma. This value replaces it, in metres, radians
# or standard deviations.
_BLIND_SIGMA = 100.0


@dataclass(frozen=True)
class Observability(CarRecord):
    """This is what the images say of B cars without any prior. It is NaN for cars that were not refined.

    Attributes:
        sigmas_m: (B, 7) standard deviations along the principal directions, the weakest direction first. In a result
            they are scaled by the calibrated factor of the depth.
        directions: (B, 7, 7) unit vectors: row i belongs to sigma i, the columns are `CAR_QUANTITIES`.
        viewing_angle_rad: (B,) KITTI's alpha, which says from which side the car is seen.
    """

    sigmas_m: Annotated[Tensor, Dense("B", 7)]
    directions: Annotated[Tensor, Dense("B", 7, 7)]
    viewing_angle_rad: Annotated[Tensor, Dense("B")]

    def words(self) -> list[str]:
        """Describe the weakest direction of each car, largest part first; cars that were not refined get an empty text.

        Examples:
            >>> direction = torch.tensor([0.45, 0.0, 0.0, 0.0, 0.89, 0.0, 0.0]).expand(1, 7, 7)
            >>> Observability(torch.full((1, 7), 0.6), direction, torch.tensor([-math.pi / 2])).words()
            ['rear view: length and depth are uncertain together, 1 to 0.5 (sigma 0.60 m)']
        """
        rows = zip(self.viewing_angle_rad.tolist(), self.directions[:, 0].tolist(), self.sigmas_m[:, 0], strict=True)
        return [
            f"{view_in_words(angle)}: {direction_in_words(direction)} (sigma {sigma:.2f} m)" if sigma == sigma else ""
            for angle, direction, sigma in rows
        ]


def view_in_words(alpha_rad: float) -> str:
    """Say from which side a car is seen at KITTI's observation angle, in steps of 45 degrees.

    Examples:
        >>> [view_in_words(math.radians(a)) for a in (-90, -50, 0, 90)]
        ['rear view', 'rear quarter view', 'side view', 'front view']
    """
    # The camera looks at the back of a car that heads away from it, where alpha is -90 degrees.
    facing = math.degrees(math.asin(max(-1.0, min(1.0, math.sin(alpha_rad)))))
    side = "front" if facing > 0 else "rear"
    if abs(facing) > 67.5:
        return f"{side} view"
    return f"{side} quarter view" if abs(facing) > 22.5 else "side view"


def direction_in_words(direction: Sequence[float]) -> str:
    """The largest parts of a direction (7,); a minus means that one part falls as the other grows."""
    order = sorted(range(len(direction)), key=lambda i: -abs(direction[i]))
    first = direction[order[0]]
    named = [i for i in order if abs(direction[i] / first) >= _NAMED_SHARE][:3]
    names = [CAR_QUANTITIES[i] for i in named]
    if len(named) == 1:
        return f"{names[0]} alone"
    ratios = " to ".join(f"{direction[i] / first + 0.0:.1f}".removesuffix(".0") for i in named)
    return f"{', '.join(names[:-1])} and {names[-1]} are uncertain together, {ratios}"


def covariance_of(fisher: Tensor) -> Tensor:
    """Invert the Fisher information (B, D, D) in the tangent of the state, without damping; NaN stands for a singular
    one.

    Silhouette pixels count with weight 1 (not the solver's 1/r), and the information is a sum over effective pixels
    (not a mean). The covariance is uncalibrated: multiply it by the s^2 fitted on data with ground truth.
    """
    finite = fisher.flatten(1).isfinite().all(1)
    identity = torch.eye(fisher.shape[-1], dtype=fisher.dtype, device=fisher.device)
    factor, info = torch.linalg.cholesky_ex(torch.where(finite[:, None, None], fisher, identity))
    regular = finite & (info == 0)
    covariance = torch.cholesky_inverse(torch.where(regular[:, None, None], factor, identity))
    return torch.where(regular[:, None, None], covariance, torch.nan)


def without_offset(information: Tensor, kept: slice) -> Tensor:
    """Marginalise the information (B, D, D) on all unknowns to the first unknowns, `kept`.

    This is Schur's complement. An offset without any information changes nothing.
    """
    others = slice(kept.stop, None)
    of_others = information.diagonal(dim1=1, dim2=2)[:, None, others]
    across = information[:, kept, others] / torch.where(of_others > 0, of_others, 1.0)
    return information[:, kept, kept] - across @ information[:, others, kept]


def covariance_xyz_yaw(
    covariance: Tensor,  # (B, 7, 7) of `CAR_QUANTITIES`
    location: Tensor,  # (B, 3) of the cars, for their viewing rays
) -> Tensor:
    """Covariance (B, 4, 4) of x, y, z along the axes of the camera and of `rotation_y`, in metres and radians.

    The axes of the reference frame are parallel to the camera's.
    """
    # Depth and sideways position lie along the viewing ray and across it on the ground. The height grows against y.
    J = torch.nn.functional.pad(_towards(location.to(covariance)).mT, (0, 1, 0, 1))
    J[:, 3, 3] = 1 / HEADING_LEVER_M
    return J @ covariance[:, :4, :4] @ J.mT


def _towards(location: Tensor) -> Tensor:
    """The directions (B, 3, 3), as rows, in which depth, sideways position and height of cars grow."""
    return viewing_axes(location) * constant_like((1.0, 1.0, -1.0), location)[:, None]


def observability_of(prior: ShapePrior, state: State, seen: Tensor | None) -> Observability:
    """Principal directions of the car's quantities, given the information (B, D, D) of all terms except the priors."""
    T_cam_obj = se3.inverse(state.T_obj_cam)
    alpha = alpha_from_kitti(T_cam_obj[:, :3, 3], rotation_y_from_pose(T_cam_obj)).to(torch.float64)
    if seen is None:
        return Observability.nothing({"B": len(alpha)}, alpha)
    sigmas, directions = _principal(seen, quantities_jacobian(prior, state))
    return Observability(sigmas, directions, alpha)


def quantities_jacobian(prior: ShapePrior, state: State) -> Tensor:
    """Compute the Jacobian (B, 7, D) of `CAR_QUANTITIES` by the tangent `(v, omega, dcode)` of the state.

    The object origin, in the middle of the footprint, moves by `-R_cam_obj v`. `rotation_y` changes by `-R_cam_obj[1]
    omega`.
    """
    T_cam_obj = se3.inverse(state.T_obj_cam).to(torch.float64)
    R_cam_obj = T_cam_obj[:, :3, :3]
    J_hwl_code = prior.dimensions_and_derivative(state.code).J_hwl_code.to(torch.float64)
    J_position = torch.cat([-_towards(T_cam_obj[:, :3, 3]) @ R_cam_obj, torch.zeros_like(R_cam_obj)], dim=2)
    J_heading = torch.cat([torch.zeros_like(R_cam_obj[:, 1]), -HEADING_LEVER_M * R_cam_obj[:, 1]], dim=1)
    J_pose = torch.cat([J_position, J_heading[:, None]], dim=1)
    no_pose, no_code = J_pose.new_zeros(len(J_pose), 3, 6), J_pose.new_zeros(len(J_pose), 4, J_hwl_code.shape[2])
    return torch.cat([torch.cat([J_pose, no_code], dim=2), torch.cat([no_pose, J_hwl_code.flip(1)], dim=2)], dim=1)


def _principal(information: Tensor, J: Tensor) -> tuple[Tensor, Tensor]:
    """Falling standard deviations (B, 7) and directions (B, 7, 7), as rows, of J (B, 7, D) times the unknowns."""
    finite = torch.cat([information, J], dim=1).flatten(1).isfinite().all(1)
    identity = torch.eye(information.shape[-1], dtype=information.dtype, device=information.device)
    information = torch.where(finite[:, None, None], information, 0.0) + identity / _BLIND_SIGMA**2
    J = torch.where(finite[:, None, None], J, 0.0)
    half = torch.linalg.solve_triangular(torch.linalg.cholesky_ex(information)[0], J.mT, upper=False)
    variances, vectors = torch.linalg.eigh(half.mT @ half)
    directions = vectors.mT.flip(1)
    # The sign of a direction has no meaning, so its largest part is made positive.
    largest = directions.gather(2, directions.abs().argmax(2, keepdim=True))
    sigmas = torch.where(finite[:, None], variances.flip(1).clamp_min(0).sqrt(), torch.nan)
    return sigmas, torch.where(finite[:, None, None], directions * largest.sign(), torch.nan)
