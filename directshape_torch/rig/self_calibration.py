"""This module finds the residual disparity field of a rig from its own images alone, without LiDAR or labels.

Motion between frames shows every bias except one proportional to disparity, which is a wrong baseline. A road at known
height has unknown pitch and roll in every frame. It shows neither the field's constant nor its slope along u. It shows
the slope along v as precisely as the height is known: an error of 1 cm of 1.65 m gives 0.4 px between the horizon and
the lower edge.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import torch
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.geometry.disparity_field import NUM_COEFFICIENTS, polynomial_basis
from directshape_torch.geometry.projection import rays_from_pixels
from directshape_torch.geometry.stereo_depth import warp_to_right
from directshape_torch.rig.pixels import COEFFICIENT_SIGMA_PX, PixelEvidence, by_degree, pixel_evidence, tukey_weight
from directshape_torch.rig.rig import Rig
from directshape_torch.stereo_matching.patch_alignment import MatchedPair
from directshape_torch.stereo_matching.plane_from_points import fit_ground_plane

# This is the standard deviation of a patch's disparity, in pixels.
PATCH_SIGMA_PX = 0.12
# Points of one frame share their scene and the errors of scene and model, so they count as this many independent
# points.
_INDEPENDENT_POINTS = 60
_NUM_ITERATIONS = 150
_FIRST_ITERATIONS = 10
_SHRINK = 0.85
_CONVERGED_PX = 1e-4
# A field less certain than this at its own data comes from the prior and not from the images.
_LARGEST_SIGMA_PX = 0.5
_LEAST_SIGMA_PX, _UNKNOWN_SIGMA_PX = 0.05, 0.2
# The next constants concern the road.
_SPACING_PX = 8
_BORDER_PX = 6
_DEPTH_RANGE_M = (4.0, 30.0)
_LARGEST_LATERAL_M = 8.0
# This is the largest difference to the disparity of the plane through the raw
# points. The plane itself contains the rig's bias.
_LARGEST_DIFFERENCE_PX = 1.5
_FEWEST_PIXELS = 100
# Roads are even to about this share of the camera's height, so disparities on them are even to this share too.
_UNEVENNESS = 0.01
# A car moves on its springs, and its road is not a plane. This is the standard deviation of the height in a frame, in
# metres.
_HEIGHT_SIGMA_M = 0.02


class Linearisation(NamedTuple):
    """These are normal equations `H delta = -g` of one constraint: M own unknowns, then the coefficients."""

    H: Tensor  # (M + 10, M + 10)
    g: Tensor  # (M + 10,)
    spread: float  # how many times larger than expected the residuals are, by their median

    def of_field(self) -> tuple[Tensor, Tensor, Tensor]:
        """Eliminate the own unknowns: H (10, 10) and g (10,) of the coefficients, and a matrix (M, 1 + 10).

        The step of the own unknowns is minus the first column, minus the other columns times the step of the
        coefficients.
        """
        H, g, M = self.H, self.g, len(self.g) - NUM_COEFFICIENTS
        # A direction of the own unknowns that the points do not show (a bend of the road) stays unchanged.
        seen = H[:M, :M] + torch.diag(1e-9 * H[:M, :M].diagonal() + 1e-12)
        own = torch.linalg.solve(seen, torch.cat([g[:M, None], H[:M, M:]], dim=1))
        return H[M:, M:] - H[M:, :M] @ own[:, 1:], g[M:] - H[M:, :M] @ own[:, 0], own


@dataclass(frozen=True)
class FieldConstraint(ABC):
    """These are points of one stereo pair that the field has to explain, with M own unknowns."""

    rig: Rig  # of the images
    seen: Tensor  # (P, 4) u, v, measured disparity, measured row shift v_left - v_right, pixels

    @abstractmethod
    def residuals(self, coefficients: Tensor) -> tuple[Tensor, Tensor]:
        """Residuals (P, R) in standard deviations, and derivatives (P, R, M + 10) by own unknowns and coefficients."""

    @abstractmethod
    def inverse_depth(self, coefficients: Tensor) -> Tensor:
        """Inverse depths (P,) that belong to the own unknowns, 1/m."""

    @abstractmethod
    def moved(self, own_step: Tensor) -> Self:
        """The constraint with changed own unknowns."""

    def known(self) -> tuple[Tensor, Tensor] | None:
        """Residual () in standard deviations of other knowledge about the own unknowns, and its derivative (M,)."""
        return None

    @property
    def uv(self) -> Tensor:
        """Pixels (P, 2)."""
        return self.seen[:, :2]

    def linearise(self, coefficients: Tensor, scale: float) -> Linearisation:
        """Linearise at coefficients (10,) and the own unknowns, for residuals that are `scale` times too large."""
        residual, J = self.residuals(coefficients)
        distances = residual.norm(dim=1)
        weight = tukey_weight(distances, scale)
        share = (_INDEPENDENT_POINTS / weight.sum().clamp_min(1e-9)).clamp_max(1.0) / scale**2
        weighted = (J * (share * weight)[:, None, None]).flatten(0, 1)
        H, g = weighted.T @ J.flatten(0, 1), weighted.T @ residual.flatten()
        if (known := self.known()) is not None:
            J_known = torch.cat([known[1], known[1].new_zeros(NUM_COEFFICIENTS)])
            H, g = H + torch.outer(J_known, J_known), g + J_known * known[0]
        # This is the median distance in one dimension, or in the two dimensions that remain of three when the depth is
        # eliminated.
        expected = 0.6745 if residual.shape[1] == 1 else math.sqrt(2 * math.log(2))
        spread = float(distances.median()) / expected if len(distances) else 1.0
        return Linearisation(H, g, spread)

    def observations(self, coefficients: Tensor, scale: float) -> Tensor:
        """Observations (Q, 4) for `pixel_evidence` at the points that count, by the depths of the own unknowns."""
        kept = tukey_weight(self.residuals(coefficients)[0].norm(dim=1), scale) > 0
        true = self.rig.displacement(self.uv, 1 / self.inverse_depth(coefficients))
        offsets = torch.stack([self.seen[:, 2] - true[:, 0], true[:, 1] - self.seen[:, 3]], dim=1)
        return torch.cat([self.uv, offsets], dim=1)[kept]

    def disparity(self, rays_cam: Tensor, inverse_depth: Tensor) -> tuple[Tensor, Tensor]:
        """True disparity (P,) and its derivative by the inverse depth (P,), pixels x metres."""
        uv_right, J_pixel_depth, _ = warp_to_right(rays_cam, 1 / inverse_depth, *self.rig[2:])
        return self.seen[:, 0] - uv_right[:, 0], J_pixel_depth[:, 0] / inverse_depth**2


class SelfCalibration(NamedTuple):
    """This is a field from images alone."""

    evidence: PixelEvidence  # its certainty is how well both halves of the constraints agree
    # This standard deviation is how far the fields of the first and of the second half of the constraints are apart. It
    # does not contain errors that both halves share (height, baseline). It is None if one half determines no field, and
    # the evidence then assumes 0.2 px.
    sigma_px: float | None
    converged: bool  # the last step was below 1e-4 px


class _Solution(NamedTuple):
    coefficients: Tensor  # (10,)
    covariance: Tensor  # (10, 10) if all constraints were independent and the model true
    observations: Tensor  # (P, 4)
    converged: bool

    def formal_sigma_px(self, size_wh: tuple[int, int]) -> float:
        """Median sigma of the bias at the data; it is several times too small, but large if nothing is seen."""
        if len(self.observations) == 0:
            return math.inf
        basis = polynomial_basis(self.observations[:, :2], size_wh)
        return float(((basis @ self.covariance) * basis).sum(dim=-1).sqrt().median())


def self_calibrate(
    constraints: Sequence[FieldConstraint], num_frames: int, on_step: Callable[[], object] = lambda: None
) -> SelfCalibration:
    """Find the field that explains all constraints best by robust Gauss-Newton that eliminates own unknowns.

    The constraints are of `num_frames` frames of one rig, in their order in time. If they do not determine the field (a
    road alone, or a car that stands), `InputError` is raised.
    """
    cure = "give consecutive frames of a car that drives past still things (a road alone shows no constant, no slope)"
    if not constraints:
        raise InputError("frames", "points that were followed from frame to frame", "none", cure)
    size_wh, solution = constraints[0].rig.size_wh, _solve(constraints, on_step)
    formal_px = solution.formal_sigma_px(size_wh)
    if not formal_px <= _LARGEST_SIGMA_PX:
        wanted = f"images that determine the field to {_LARGEST_SIGMA_PX} px"
        raise InputError("frames", wanted, f"{formal_px:.2g} px", cure)
    sigma_px = _sigma_from_halves(constraints, solution.observations, size_wh, on_step)
    # The covariance of independent points promises several times smaller errors than the difference of the halves.
    share = (formal_px / max(sigma_px or _UNKNOWN_SIGMA_PX, _LEAST_SIGMA_PX)) ** 2
    information = min(share, 1.0) * torch.linalg.inv(solution.covariance)
    of_pixels = pixel_evidence(solution.observations, size_wh, num_frames)
    evidence = of_pixels._replace(information=information, vector=information @ solution.coefficients)
    return SelfCalibration(evidence, sigma_px, solution.converged)


def _solve(constraints: Sequence[FieldConstraint], on_step: Callable[[], object]) -> _Solution:
    current, scales = list(constraints), [5.0] * len(constraints)
    sigma = by_degree(COEFFICIENT_SIGMA_PX)
    H_prior, coefficients = torch.diag(1 / sigma**2), torch.zeros_like(sigma)
    H, converged = H_prior, False
    for iteration in range(_NUM_ITERATIONS):
        linear = [c.linearise(coefficients, scale) for c, scale in zip(current, scales, strict=True)]
        parts = [one.of_field() for one in linear]
        H = H_prior + sum(part[0] for part in parts)
        step = -torch.linalg.solve(H, H_prior @ coefficients + sum(part[1] for part in parts))
        coefficients = coefficients + step
        current = [c.moved(-(own[:, 0] + own[:, 1:] @ step)) for c, (_, _, own) in zip(current, parts, strict=True)]
        shrink = math.inf if iteration < _FIRST_ITERATIONS else _SHRINK
        scales = [max(1.0, min(shrink * old, new.spread)) for old, new in zip(scales, linear, strict=True)]
        on_step()
        converged = iteration > _FIRST_ITERATIONS and float(step.abs().max()) < _CONVERGED_PX
        if converged:
            break
    observations = [c.observations(coefficients, s) for c, s in zip(current, scales, strict=True)]
    seen = torch.cat([sigma.new_zeros(0, 4), *observations])
    return _Solution(coefficients, torch.linalg.inv(H), seen, converged)


def _sigma_from_halves(
    constraints: Sequence[FieldConstraint],
    observations: Tensor,  # (P, 4)
    size_wh: tuple[int, int],
    on_step: Callable[[], object],
) -> float | None:
    """Half of the RMS difference between the fields of two halves, which is the standard deviation of their mean."""
    middle = len(constraints) // 2
    first, second = (_solve(part, on_step) for part in (constraints[:middle], constraints[middle:]))
    if max(first.formal_sigma_px(size_wh), second.formal_sigma_px(size_wh)) > _LARGEST_SIGMA_PX:
        return None
    difference = polynomial_basis(observations[:, :2], size_wh) @ (first.coefficients - second.coefficients)
    return 0.5 * float(difference.square().mean().sqrt())


@dataclass(frozen=True)
class RoadConstraint(FieldConstraint):
    """This is the road of one frame, a plane at a known height. The own unknowns are `inverse_plane`.

    The inverse depth is `inverse_plane . ray_cam`, so the disparity is an affine function of the pixel.
    """

    inverse_plane: Tensor  # (3,) `a` with `a . x_cam = 1` on the road, 1/m: minus the upward normal over the height
    height_m: float  # of the camera above the road

    def residuals(self, coefficients: Tensor) -> tuple[Tensor, Tensor]:
        """Predicted minus measured disparity in standard deviations, and its derivatives."""
        rays_cam = rays_from_pixels(self.uv, self.rig.K_left)
        predicted, slope = self.disparity(rays_cam, self.inverse_depth(coefficients))
        basis = polynomial_basis(self.uv, self.rig.size_wh)
        sigma = (PATCH_SIGMA_PX**2 + (_UNEVENNESS * self.rig.of_depth(self.seen[:, 2:3])) ** 2).sqrt()
        residual = (predicted + basis @ coefficients - self.seen[:, 2])[:, None] / sigma
        return residual, (torch.cat([slope[:, None] * rays_cam, basis], dim=1) / sigma)[:, None]

    def inverse_depth(self, coefficients: Tensor) -> Tensor:
        """Inverse depths (P,) of the plane, 1/m."""
        return (rays_from_pixels(self.uv, self.rig.K_left) @ self.inverse_plane).clamp_min(1e-4)

    def moved(self, own_step: Tensor) -> Self:
        """The constraint with its plane changed by a step."""
        return replace(self, inverse_plane=self.inverse_plane + own_step)

    def known(self) -> tuple[Tensor, Tensor]:
        """Residual () of the camera's height in standard deviations, and its derivative (3,)."""
        height = 1 / self.inverse_plane.norm()
        return (height - self.height_m) / _HEIGHT_SIGMA_M, -self.inverse_plane * height**3 / _HEIGHT_SIGMA_M


def find_road(pair: MatchedPair, rig: Rig, height_m: float) -> RoadConstraint | None:
    """Constraint of the pixels 4 to 30 m ahead that lie near the dominant plane; None if no road is seen."""
    seen = pair.seen_at(_grid(pair.matched))
    rays_cam = rays_from_pixels(seen[:, :2], rig.K_left)
    plane = fit_ground_plane(rig.depth(seen[:, :2], seen[:, 2])[:, None] * rays_cam)
    if plane is None:
        return None
    inverse_plane = -plane[0] / plane[1]
    depth = 1 / (rays_cam @ inverse_plane).clamp_min(1e-3)
    near = (seen[:, 2] - rig.displacement(seen[:, :2], depth)[:, 0]).abs() < _LARGEST_DIFFERENCE_PX
    ahead = (depth > _DEPTH_RANGE_M[0]) & (depth < _DEPTH_RANGE_M[1])
    on_road = near & ahead & ((depth * rays_cam[:, 0]).abs() < _LARGEST_LATERAL_M)
    if int(on_road.sum()) < _FEWEST_PIXELS:
        return None
    return RoadConstraint(rig, seen[on_road], inverse_plane, height_m)


def _grid(matched: Tensor) -> Tensor:
    """Every eighth pixel (P, 2) of the lower half that has a disparity."""
    height, width = matched.shape
    v = torch.arange(height // 2, height - _BORDER_PX, _SPACING_PX)
    u = torch.arange(_BORDER_PX, width - _BORDER_PX, _SPACING_PX)
    uv = torch.stack(torch.meshgrid(u, v, indexing="xy"), dim=-1).reshape(-1, 2)
    return uv[matched[uv[:, 1], uv[:, 0]].isfinite()].double()
