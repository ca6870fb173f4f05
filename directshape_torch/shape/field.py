"""Every term looks up the signed distances of all cars here, at points of blocks whose first axis is the coordinate."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from directshape_torch.numerics.tensors import length
from directshape_torch.shape.sdf_grid import GridShape, RayMinimum
from directshape_torch.shape.shape_prior import BoundShape, SdfDerivatives

# A search along a ray that knows only values begins with three samples at this distance from each other.
_FIRST_SAMPLES_M = 0.06
# Each round of the search samples this many times as finely as the round before.
_FINER = 4.0
_ROUNDS = 3
# A parabola's vertex is a guess where it is more than this many sample distances away.
_MAX_SAMPLE_DISTANCES = 1.5
# A second difference of three samples below this one is rounding.
_LEAST_CURVATURE_M = 1e-6


class Field(Protocol):
    """A `Field` gives signed distances of B cars; points (3, ..., M, R) belong to the cars (M,) of their blocks."""

    def sdf(self, points_obj: Tensor, owner: Tensor, inside: bool = False) -> Tensor:
        """Signed distance (..., M, R), metres; `inside` says that the points that count are within the bounds."""
        ...

    def gradient(self, points_obj: Tensor, owner: Tensor) -> Tensor:
        """Gradient (3, ..., M, R) of the signed distance, as a constant."""
        ...

    def derivatives(
        self, points_obj: Tensor, owner: Tensor, constant: bool = False, inside: bool = False
    ) -> SdfDerivatives:
        """Value, gradient and code derivative of the signed distance.

        `constant` says that they will not be differentiated again, `inside` that all points that count are within the
        prior's bounds.
        """
        ...

    def minimum_along(
        self,
        owner: Tensor,
        centre_obj: Tensor,  # (3, M, 1)
        direction_obj: Tensor,  # (3, M, R)
        depth: Tensor,  # (M, R) where the search begins
        near: Tensor,  # (M, R)
        far: Tensor,  # (M, R)
        max_cells: int,
    ) -> RayMinimum:
        """The least signed distance along rays, as a constant."""
        ...

    def curvature_along(self, owner: Tensor, centre_obj: Tensor, direction_obj: Tensor, depth: Tensor) -> Tensor:
        """Second derivative (M, R) of the signed distance by the depth, at depths (M, R), as a constant."""
        ...


class PackedField(NamedTuple):
    """`PackedField` is the field of any shape that takes packed points."""

    shape: BoundShape

    def sdf(self, points_obj: Tensor, owner: Tensor, inside: bool = False) -> Tensor:
        return self.shape.value(*_packed(points_obj, owner)).view(points_obj.shape[1:])

    def gradient(self, points_obj: Tensor, owner: Tensor) -> Tensor:
        return self.derivatives(points_obj, owner, constant=True).gradient.detach()

    def derivatives(
        self, points_obj: Tensor, owner: Tensor, constant: bool = False, inside: bool = False
    ) -> SdfDerivatives:
        at = self.shape.value_and_derivatives(*_packed(points_obj, owner))
        leading = points_obj.shape[1:]
        return SdfDerivatives(
            at.value.view(leading),
            at.gradient.mT.reshape(3, *leading),
            at.J_value_code.view(*leading, at.J_value_code.shape[-1]),
        )

    def minimum_along(
        self,
        owner: Tensor,
        centre_obj: Tensor,
        direction_obj: Tensor,
        depth: Tensor,
        near: Tensor,
        far: Tensor,
        max_cells: int,
    ) -> RayMinimum:
        """Find the minimum by vertices of ever narrower parabolas; the field need only be smooth."""
        value_at = self._along(owner, centre_obj, direction_obj)
        step = _FIRST_SAMPLES_M / length(direction_obj, dim=0)
        for _ in range(_ROUNDS):
            before, here, after = value_at(torch.stack([depth - step, depth, depth + step]))
            second, slope = before - 2 * here + after, 0.5 * (after - before)
            # Where the field does not curve upwards, the slope only tells on which side the minimum is.
            vertex = -slope / second.clamp_min(_LEAST_CURVATURE_M)
            depth = depth + vertex.clamp(-_MAX_SAMPLE_DISTANCES, _MAX_SAMPLE_DISTANCES) * step
            depth = torch.minimum(torch.maximum(depth, near), far)
            step = step / _FINER
        return RayMinimum(depth, torch.zeros_like(direction_obj))

    def curvature_along(self, owner: Tensor, centre_obj: Tensor, direction_obj: Tensor, depth: Tensor) -> Tensor:
        step = _FIRST_SAMPLES_M / _FINER**2 / length(direction_obj, dim=0)
        samples = torch.stack([depth - step, depth, depth + step])
        before, here, after = self._along(owner, centre_obj, direction_obj)(samples)
        curvature: Tensor = (before - 2 * here + after) / (step * step)
        return curvature

    def _along(self, owner: Tensor, centre_obj: Tensor, direction_obj: Tensor) -> Callable[[Tensor], Tensor]:
        """A function that gives the signed distances (n, M, R) at depths (n, M, R) of rays."""
        return lambda depths: self.sdf(centre_obj[:, None] + depths * direction_obj[:, None], owner)


def field_of(shape: BoundShape) -> Field:
    """The field of a bound shape: a `GridShape` is one itself, but a class of one's own made of it may look up anew."""
    return shape if type(shape) is GridShape else PackedField(shape)


def _packed(points_obj: Tensor, owner: Tensor) -> tuple[Tensor, Tensor]:
    index = owner[:, None].expand(points_obj.shape[1:])
    return points_obj.flatten(1).mT, index.reshape(-1)
