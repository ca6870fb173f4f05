"""Sums of weighted rows into one gradient and one matrix per object, in float64, in a fixed order."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

_BLOCK = 64


def sum_over_blocks(
    per_block: Tensor,  # (M, ...)
    object_blocks: Tensor,  # (B, 2^n) block numbers of each object; M stands for an empty place
) -> Tensor:
    """Sums (B, ...) over the blocks of each object, pairwise: empty places change no bit."""
    padded = torch.cat([per_block, per_block.new_zeros(1, *per_block.shape[1:])])
    # In less time than `padded[object_blocks]`.
    part = padded.index_select(0, object_blocks.reshape(-1)).view(*object_blocks.shape, *per_block.shape[1:])
    while part.shape[1] > 1:
        part = part[:, 0::2] + part[:, 1::2]
    return part[:, 0]


@dataclass(frozen=True)
class RowBlocks:
    """Rows of several objects, sorted by object, cut into blocks of equal size.

    Attributes:
        object_index: (P,) object of each row, ascending.
        counts: (B,) rows of each object.
        owner: (M,) object of each block.
        block_rows: (M, 64) row numbers; P stands for an empty place.
    """

    object_index: Tensor
    counts: Tensor
    owner: Tensor
    block_rows: Tensor

    @classmethod
    def of_sorted(cls, object_index: Tensor, num_objects: int) -> RowBlocks:
        """Blocks of rows whose objects (P,) ascend.

        Example:
            >>> RowBlocks.of_sorted(torch.tensor([0, 0, 2]), 3).owner
            tensor([0, 2])
        """
        counts = torch.bincount(object_index, minlength=num_objects)
        num_blocks = _num_blocks(counts)
        owner = torch.repeat_interleave(torch.arange(num_objects, device=counts.device), num_blocks)
        first_block = torch.cumsum(num_blocks, 0) - num_blocks
        first_row = torch.cumsum(counts, 0) - counts
        block_in_object = torch.arange(len(owner), device=counts.device) - first_block[owner]
        place = block_in_object[:, None] * _BLOCK + torch.arange(_BLOCK, device=counts.device)
        rows = torch.where(place < counts[owner][:, None], first_row[owner][:, None] + place, len(object_index))
        return RowBlocks(object_index, counts, owner, rows)

    @property
    def num_objects(self) -> int:
        return len(self.counts)


@dataclass(frozen=True)
class Segments(RowBlocks):
    """Blocks of rows with the order in which those of an object are added.

    Blocks are products of matrices of fixed shape, and the blocks of an object are added in a fixed order, hence the
    sums are the same to the bit from run to run on any device; an atomic `index_add_` on a GPU would not be. No row
    enters the sum of another object, not even with weight zero: NaN in one object stays there.

    Attributes:
        object_blocks: (B, 2^n) block numbers of each object, in order; M stands for an empty place.
    """

    object_blocks: Tensor

    @classmethod
    def from_sorted_index(cls, object_index: Tensor, num_objects: int) -> Segments:
        """Plan the sums for rows whose objects (P,) ascend.

        Example:
            >>> Segments.from_sorted_index(torch.tensor([0, 0, 2]), 3).counts
            tensor([2, 0, 1])
        """
        rows = RowBlocks.of_sorted(object_index, num_objects)
        num_blocks = _num_blocks(rows.counts)
        first_block = torch.cumsum(num_blocks, 0) - num_blocks
        # A power of two for the pairwise sums; its shape is known from the longest object, for which the host waits.
        longest = int(num_blocks.max()) if num_objects else 0
        place = torch.arange(1 << max(longest - 1, 0).bit_length(), device=num_blocks.device)
        blocks = torch.where(place < num_blocks[:, None], first_block[:, None] + place, len(rows.owner))
        return cls(rows.object_index, rows.counts, rows.owner, rows.block_rows, blocks)

    def _blocks(self, rows: Tensor) -> Tensor:
        padded = torch.cat([rows, rows.new_zeros(1, *rows.shape[1:])])
        return padded[self.block_rows].to(torch.float64)

    def sum(self, values: Tensor) -> Tensor:
        """Sum (B,) of values (P,) over the rows of each object, float64; differentiable."""
        return sum_over_blocks(self._blocks(values).sum(dim=1), self.object_blocks)

    def accumulate(
        self,
        rows: Tensor,  # (P, D) Jacobians
        gradient_weight: Tensor,  # (P,) c rho'(r) for each row
        *hessian_weights: Tensor,  # (P,) c rho'(r) / r for each row
    ) -> tuple[Tensor, ...]:
        """`g = sum w_g J` (B, D), and for each of the weights `H = sum w_H J^T J` (B, D, D), float64."""
        J = self._blocks(rows)
        gradient = (self._blocks(gradient_weight)[:, None] @ J)[:, 0]
        weighted = (J * self._blocks(weight)[..., None] for weight in hessian_weights)
        products = (gradient, *(w.transpose(1, 2) @ J for w in weighted))
        return tuple(sum_over_blocks(product, self.object_blocks) for product in products)


def _num_blocks(counts: Tensor) -> Tensor:
    return (counts + _BLOCK - 1) // _BLOCK
