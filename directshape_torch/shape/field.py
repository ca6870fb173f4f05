"""Signed distances of all cars at points of blocks, coordinate first: what every term looks up."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

from torch import Tensor

from directshape_torch.shape.ray_minimum import (
    RayMinimum,
    curvature_by_values,
    curvature_in_grids,
    minimum_by_values,
    minimum_in_grids,
)
from directshape_torch.shape.sdf_grid import GridField, GridShape, Lookup, derivatives_at, gradient_at, value_at
from directshape_torch.shape.shape_prior import BoundShape


class Field(Protocol):
    """Signed distances of B cars; points are (3, ..., M, R) and belong to the cars (M,) of their blocks."""

    def value(self, points_obj: Tensor, owner: Tensor, inside: bool = False) -> Tensor:
        """Signed distance (..., M, R), metres; `inside`: no point that counts lies outside of the prior's bounds."""
        ...

    def gradient(self, points_obj: Tensor, owner: Tensor) -> Tensor:
        """Gradient (3, ..., M, R), a constant."""
        ...

    def derivatives(self, points_obj: Tensor, owner: Tensor, constant: bool = False, inside: bool = False) -> Lookup:
        """Value, gradient and code derivative; `constant`: nothing will be differentiated again; `inside` as above."""
        ...

    def minimum_along(
        self,
        owner: Tensor,
        centre_obj: Tensor,  # (3, M, 1)
        direction_obj: Tensor,  # (3, M, R)
        depth: Tensor,  # (M, R) to begin at
        near: Tensor,  # (M, R)
        far: Tensor,  # (M, R)
        max_cells: int,
    ) -> RayMinimum:
        """The least signed distance along rays, a constant."""
        ...

    def curvature_along(self, owner: Tensor, centre_obj: Tensor, direction_obj: Tensor, depth: Tensor) -> Tensor:
        """Second derivative (M, R) of the signed distance by the depth, at depths (M, R), a constant."""
        ...


class Grids(NamedTuple):
    """The field of grids."""

    grids: GridField

    def value(self, points_obj: Tensor, owner: Tensor, inside: bool = False) -> Tensor:
        return value_at(self.grids, points_obj, owner[:, None], inside)

    def gradient(self, points_obj: Tensor, owner: Tensor) -> Tensor:
        return gradient_at(self.grids, points_obj, owner[:, None])

    def derivatives(self, points_obj: Tensor, owner: Tensor, constant: bool = False, inside: bool = False) -> Lookup:
        return derivatives_at(self.grids, points_obj, owner[:, None], constant, inside)

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
        return minimum_in_grids(self.grids, owner, centre_obj, direction_obj, depth, near, far, max_cells)

    def curvature_along(self, owner: Tensor, centre_obj: Tensor, direction_obj: Tensor, depth: Tensor) -> Tensor:
        return curvature_in_grids(self.grids, owner, centre_obj, direction_obj, depth)


class PackedField(NamedTuple):
    """The field of any shape that takes packed points."""

    shape: BoundShape

    def value(self, points_obj: Tensor, owner: Tensor, inside: bool = False) -> Tensor:
        return self.shape.value(*_packed(points_obj, owner)).view(points_obj.shape[1:])

    def gradient(self, points_obj: Tensor, owner: Tensor) -> Tensor:
        return self.derivatives(points_obj, owner, constant=True).gradient.detach()

    def derivatives(self, points_obj: Tensor, owner: Tensor, constant: bool = False, inside: bool = False) -> Lookup:
        at = self.shape.value_and_derivatives(*_packed(points_obj, owner))
        leading = points_obj.shape[1:]
        return Lookup(
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
        return minimum_by_values(self._along(owner, centre_obj, direction_obj), direction_obj, depth, near, far)

    def curvature_along(self, owner: Tensor, centre_obj: Tensor, direction_obj: Tensor, depth: Tensor) -> Tensor:
        return curvature_by_values(self._along(owner, centre_obj, direction_obj), direction_obj, depth)

    def _along(self, owner: Tensor, centre_obj: Tensor, direction_obj: Tensor) -> Callable[[Tensor], Tensor]:
        """Signed distances (n, M, R) at depths (n, M, R) of rays."""
        return lambda depths: self.value(centre_obj[:, None] + depths * direction_obj[:, None], owner)


def field_of(shape: BoundShape) -> Field:
    """The field of a bound shape: that of its grids, where it looks up in them as a `GridShape` does."""
    looks_up = type(shape).value, type(shape).value_and_derivatives
    if isinstance(shape, GridShape) and looks_up == (GridShape.value, GridShape.value_and_derivatives):
        return Grids(shape.field)
    return PackedField(shape)


def _packed(points_obj: Tensor, owner: Tensor) -> tuple[Tensor, Tensor]:
    index = owner[:, None].expand(points_obj.shape[1:])
    return points_obj.flatten(1).mT, index.reshape(-1)
