"""Bound shapes at coordinate-first points of blocks: grids directly, any other shape through its packed form."""

from __future__ import annotations

from typing import NamedTuple, Protocol

from torch import Tensor

from directshape_torch.shape.grid_cells import GridField, Lookup
from directshape_torch.shape.grid_lookup import derivatives_at, value_at
from directshape_torch.shape.sdf_grid import GridShape
from directshape_torch.shape.shape_prior import BoundShape


class BlockField(Protocol):
    """Signed distances of the objects of M blocks."""

    def value(self, points_obj: Tensor, owner: Tensor, constant: bool = False) -> Tensor:
        """(..., M, 64) metres at points (3, ..., M, 64) of the objects (M,); `constant`: not to be differentiated."""
        ...

    def derivatives(self, points_obj: Tensor, owner: Tensor, constant: bool = False) -> Lookup:
        """Value, gradient and code derivative there; `constant`: nothing will be differentiated again."""
        ...


class GridBlockField(NamedTuple):
    """Of grids."""

    grids: GridField

    def value(self, points_obj: Tensor, owner: Tensor, constant: bool = False) -> Tensor:
        return value_at(self.grids, points_obj, owner[:, None], constant)

    def derivatives(self, points_obj: Tensor, owner: Tensor, constant: bool = False) -> Lookup:
        return derivatives_at(self.grids, points_obj, owner[:, None], constant)


class PackedBlockField(NamedTuple):
    """Of any shape that takes packed points."""

    shape: BoundShape

    def value(self, points_obj: Tensor, owner: Tensor, constant: bool = False) -> Tensor:
        return self.shape.value(*_packed(points_obj, owner)).view(points_obj.shape[1:])

    def derivatives(self, points_obj: Tensor, owner: Tensor, constant: bool = False) -> Lookup:
        at = self.shape.value_and_derivatives(*_packed(points_obj, owner))
        leading = points_obj.shape[1:]
        return Lookup(
            at.value.view(leading),
            at.gradient.mT.view(3, *leading),
            at.J_value_code.view(*leading, at.J_value_code.shape[-1]),
        )


def block_field(shape: BoundShape) -> BlockField:
    """The fields of a bound shape, for points in blocks."""
    # Not `isinstance`: a shape that looks up in its own way must be asked.
    return GridBlockField(shape.field) if type(shape) is GridShape else PackedBlockField(shape)


def _packed(points_obj: Tensor, owner: Tensor) -> tuple[Tensor, Tensor]:
    index = owner[:, None].expand(points_obj.shape[1:])
    return points_obj.flatten(1).mT, index.reshape(-1)
