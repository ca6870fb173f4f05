"""Signed distance grids as a shape: value, spatial gradient and code derivative at packed points (`grid_lookup`)."""

from __future__ import annotations

from torch import Tensor

from directshape_torch.numerics.gradient_mode import nothing_is_differentiated
from directshape_torch.shape.grid_cells import GridField
from directshape_torch.shape.grid_lookup import derivatives_at, gradient_at, value_at
from directshape_torch.shape.shape_prior import SdfDerivatives


class GridShape:
    """B signed distance fields on one common grid, with the code derivative of all of them (a `BoundShape`).

    Args:
        values: signed distance at the nodes, (B, nx, ny, nz), metres.
        basis: derivative of the nodes by the code, (nx, ny, nz, K), metres per standard deviation.
        origin: position of node (0, 0, 0) in the object frame, (3,), metres.
        spacing_m: distance between nodes, metres.

    Example:
        >>> import torch
        >>> height_above_ground = -torch.arange(-2.0, 2.0)[None, None, :, None].expand(1, 3, 4, 3)
        >>> shape = GridShape(height_above_ground, torch.zeros(3, 4, 3, 1), torch.tensor([0.0, -2.0, 0.0]), 1.0)
        >>> shape.value(torch.tensor([[1.0, -0.5, 1.0]]), torch.tensor([0]))
        tensor([0.5000])
    """

    def __init__(self, values: Tensor, basis: Tensor, origin: Tensor, spacing_m: float) -> None:
        self.values = values
        self.field = GridField(values.reshape(-1), basis, origin, spacing_m)

    @property
    def basis(self) -> Tensor:
        """Derivative of the nodes by the code, (nx, ny, nz, K), metres per standard deviation."""
        return self.field.basis

    @property
    def origin(self) -> Tensor:
        """Position of node (0, 0, 0), (3,), metres."""
        return self.field.origin

    @property
    def spacing_m(self) -> float:
        """Distance between nodes, metres."""
        return self.field.spacing_m

    def value(self, points_obj: Tensor, object_index: Tensor) -> Tensor:
        """Signed distance (P,) in metres at points (P, 3) of objects (P,)."""
        return value_at(self.field, points_obj.mT.contiguous(), object_index, nothing_is_differentiated())

    def value_and_derivatives(self, points_obj: Tensor, object_index: Tensor) -> SdfDerivatives:
        """Value (P,), gradient (P, 3) and code derivative (P, K) at points (P, 3) of objects (P,).

        The gradient is the exact derivative of the trilinear lookup and of its continuation.
        """
        at = derivatives_at(self.field, points_obj.mT.contiguous(), object_index, nothing_is_differentiated())
        return SdfDerivatives(at.value, at.gradient.mT.contiguous(), at.J_value_code)

    def gradient(self, points_obj: Tensor, object_index: Tensor) -> Tensor:
        """That gradient (P, 3) by itself, for what is not differentiated again."""
        return gradient_at(self.field, points_obj.mT.contiguous(), object_index).mT.contiguous()
