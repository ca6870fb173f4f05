"""Signed distance grids as a shape: value, spatial gradient and code derivative at packed points (`grid_lookup`)."""

from __future__ import annotations

import torch
from torch import Tensor

from directshape_torch.device_constants import constant_like
from directshape_torch.gradient_mode import nothing_is_differentiated
from directshape_torch.shape.grid_cells import GridField
from directshape_torch.shape.grid_lookup import derivatives_at, gradient_at, value_at
from directshape_torch.shape.shape_prior import SdfDerivatives


class GridMemory:
    """Room for the grids of shapes of which each ends when the next begins, and the table that they are made from.

    Grids are megabytes: memory that the system must first hand out costs more than what is computed into it. It serves
    one family of shapes at a time, whose tensors stay as they are.

    Example:
        >>> memory = GridMemory()
        >>> memory.room(torch.zeros(4, 1), 6).shape, memory.room(torch.zeros(2, 1), 6).shape
        (torch.Size([4, 6]), torch.Size([2, 6]))
    """

    def __init__(self) -> None:
        self._numbers: Tensor | None = None
        self._table: tuple[Tensor, Tensor, Tensor] | None = None  # with what it was made from

    def room(self, code: Tensor, num_nodes: int) -> Tensor:
        """Memory (B, num_nodes) with any contents for the grids of codes (B, K); the room given before ends."""
        count = len(code) * num_nodes
        if self._numbers is None or not _can_hold(self._numbers, count, code):
            self._numbers = code.new_empty(count)
        return self._numbers[:count].view(len(code), num_nodes)

    def values(self, mean: Tensor, basis: Tensor, code: Tensor) -> Tensor:
        """`mean + basis code` (B, V) at V nodes, in that room, of a mean (...), a basis (..., K) and codes (B, K).

        One product with a table of whole rows: the result is written once, by a product and a sum twice.
        """
        if self._table is None or self._table[0] is not mean or self._table[1] is not basis:
            num_codes = basis.shape[-1]
            self._table = mean, basis, torch.cat([basis.reshape(-1, num_codes).T, mean.reshape(1, -1)])
        with_mean = torch.nn.functional.pad(code, (0, 1), value=1.0)
        return torch.mm(with_mean, self._table[2], out=self.room(code, mean.numel()))


def _can_hold(numbers: Tensor, count: int, code: Tensor) -> bool:
    if len(numbers) < count or (numbers.dtype, numbers.device) != (code.dtype, code.device):
        return False
    # What inference mode made cannot be written to outside of it.
    return torch.is_inference_mode_enabled() or not numbers.is_inference()


class GridShape:
    """B signed distance fields on one common grid, with the code derivative of all of them (a `BoundShape`).

    Args:
        values: signed distance at the nodes, (B, nx, ny, nz), metres.
        basis: derivative of the nodes by the code, (nx, ny, nz, K), metres per standard deviation.
        origin: position of node (0, 0, 0) in the object frame, (3,), metres.
        spacing_m: distance between nodes, metres.

    Example:
        >>> height_above_ground = -torch.arange(-2.0, 2.0)[None, None, :, None].expand(1, 3, 4, 3)
        >>> shape = GridShape(height_above_ground, torch.zeros(3, 4, 3, 1), torch.tensor([0.0, -2.0, 0.0]), 1.0)
        >>> shape.value(torch.tensor([[1.0, -0.5, 1.0]]), torch.tensor([0]))
        tensor([0.5000])
    """

    def __init__(self, values: Tensor, basis: Tensor, origin: Tensor, spacing_m: float) -> None:
        self.values = values
        last_node = constant_like(tuple(count - 1 for count in values.shape[1:]), origin)
        self.field = GridField(values.reshape(-1), basis, origin, last_node, spacing_m)

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
