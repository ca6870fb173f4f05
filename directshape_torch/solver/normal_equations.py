"""Sums of weighted rows into one gradient and one matrix per object, in float64, in a fixed order."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

_BLOCK = 64


@dataclass(frozen=True)
class Segments:
    """Rows of several objects, sorted by object, cut into blocks of equal size for batched products.

    Sums over blocks are products of matrices of fixed shape, hence the same to the bit from run to run on any device;
    an atomic `index_add_` on a GPU would not be.

    Attributes:
        object_index: (P,) object of each row, ascending.
        counts: (B,) rows of each object.
        block_rows: (M, 64) row numbers; P stands for an empty place.
        block_owner: (B, M) float64, one where a block belongs to an object.
    """

    object_index: Tensor
    counts: Tensor
    block_rows: Tensor
    block_owner: Tensor

    @classmethod
    def from_sorted_index(cls, object_index: Tensor, num_objects: int) -> Segments:
        """Plan the sums for rows whose objects (P,) ascend.

        Example:
            >>> Segments.from_sorted_index(torch.tensor([0, 0, 2]), 3).counts
            tensor([2, 0, 1])
        """
        counts = torch.bincount(object_index, minlength=num_objects)
        num_blocks = (counts + _BLOCK - 1) // _BLOCK
        owner = torch.repeat_interleave(torch.arange(num_objects, device=counts.device), num_blocks)
        first_block = torch.cumsum(num_blocks, 0) - num_blocks
        first_row = torch.cumsum(counts, 0) - counts
        block_in_object = torch.arange(len(owner), device=counts.device) - first_block[owner]
        place = block_in_object[:, None] * _BLOCK + torch.arange(_BLOCK, device=counts.device)
        rows = torch.where(place < counts[owner][:, None], first_row[owner][:, None] + place, len(object_index))
        member = owner[None] == torch.arange(num_objects, device=counts.device)[:, None]
        return cls(object_index, counts, rows, member.to(torch.float64))

    @property
    def num_objects(self) -> int:
        return len(self.counts)

    def _blocks(self, rows: Tensor) -> Tensor:
        padded = torch.cat([rows, rows.new_zeros(1, *rows.shape[1:])])
        return padded[self.block_rows].to(torch.float64)

    def sum(self, values: Tensor) -> Tensor:
        """Sum (B,) of values (P,) over the rows of each object, float64; differentiable."""
        return self.block_owner @ self._blocks(values).sum(dim=1)

    def accumulate(
        self,
        rows: Tensor,  # (P, D) Jacobians
        gradient_weight: Tensor,  # (P,) c rho'(r) for each row
        hessian_weight: Tensor,  # (P,) c rho'(r) / r for each row
    ) -> tuple[Tensor, Tensor]:
        """`g = sum w_g J` (B, D) and `H = sum w_H J^T J` (B, D, D), float64."""
        J = self._blocks(rows)
        weighted = J * self._blocks(hessian_weight)[..., None]
        gradient = (self._blocks(gradient_weight)[:, None] @ J)[:, 0]
        hessian = weighted.transpose(1, 2) @ J
        d = rows.shape[1]
        return self.block_owner @ gradient, (self.block_owner @ hessian.reshape(-1, d * d)).reshape(-1, d, d)
