"""Sums of weighted rows into one gradient and one matrix per object, in float64, in a fixed order."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import torch
from torch import Tensor

from directshape_torch.device_constants import kept_property
from directshape_torch.gradient_mode import nothing_is_differentiated
from directshape_torch.table_lookup import occurrences

_BLOCK = 64


@dataclass(frozen=True)
class RowBlocks:
    """Rows of several objects, sorted by object, cut into blocks of equal size where somebody asks for them.

    Attributes:
        object_index: (P,) object of each row, ascending.
        counts: (B,) rows of each object.
    """

    object_index: Tensor
    counts: Tensor

    @classmethod
    def of_sorted(cls, object_index: Tensor, num_objects: int) -> Self:
        """For rows whose objects (P,) ascend.

        Example:
            >>> RowBlocks.of_sorted(torch.tensor([0, 0, 2]), 3).owner
            tensor([0, 2])
        """
        return cls(object_index, occurrences(object_index, num_objects))

    @property
    def num_objects(self) -> int:
        return len(self.counts)

    @kept_property
    def num_blocks(self) -> Tensor:
        """Blocks (B,) of each object."""
        return (self.counts + _BLOCK - 1) // _BLOCK

    @cached_property
    def known_num_blocks(self) -> tuple[int, ...]:
        """The same on the host, which waits for them once."""
        return tuple(self.num_blocks.tolist())

    @kept_property
    def owner(self) -> Tensor:
        """Object (M,) of each block."""
        objects = torch.arange(self.num_objects, device=self.counts.device)
        return torch.repeat_interleave(objects, self.num_blocks, output_size=sum(self.known_num_blocks))

    @kept_property
    def block_rows(self) -> Tensor:
        """Row numbers (M, 64); P stands for an empty place."""
        owner, counts = self.owner, self.counts
        first_row = torch.cumsum(counts, 0) - counts
        block_in_object = torch.arange(len(owner), device=counts.device) - self._first_block[owner]
        place = block_in_object[:, None] * _BLOCK + torch.arange(_BLOCK, device=counts.device)
        rows = first_row[owner][:, None] + place
        return torch.where(place < counts[owner][:, None], rows, len(self.object_index))

    @kept_property
    def _first_block(self) -> Tensor:
        return torch.cumsum(self.num_blocks, 0) - self.num_blocks


class Segments(RowBlocks):
    """Rows of objects with the order in which those of an object are added.

    It is the rows' own, one after the other or block by block, hence the sums are the same to the bit from run to run
    on any device; those of an atomic `index_add_` on a GPU would not be. No row enters the sum of another object, not
    even with weight zero: NaN in one object stays there.

    Where something is differentiated the sums are made of operations that can be differentiated in both modes and
    again; else of a single one.
    """

    @kept_property
    def object_blocks(self) -> Tensor:
        """Block numbers (B, 2^n) of each object, in order; M stands for an empty place."""
        # A power of two for the pairwise sums.
        longest = max(self.known_num_blocks, default=0)
        place = torch.arange(1 << max(longest - 1, 0).bit_length(), device=self.counts.device)
        blocks = self._first_block[:, None] + place
        return torch.where(place < self.num_blocks[:, None], blocks, len(self.owner))

    def sum(self, values: Tensor) -> Tensor:
        """Sum (B, ...) of values (P, ...) over the rows of each object, float64; differentiable."""
        if nothing_is_differentiated():
            return _sum_of_runs(values.to(torch.float64), self.counts)
        return self._sum_over_blocks(self._blocks(values).sum(dim=1))

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
        return tuple(self._sum_over_blocks(product) for product in products)

    def _blocks(self, rows: Tensor) -> Tensor:
        padded = torch.cat([rows, rows.new_zeros(1, *rows.shape[1:])])
        return padded[self.block_rows].to(torch.float64)

    def _sum_over_blocks(self, per_block: Tensor) -> Tensor:
        """Sums (B, ...) of (M, ...) over the blocks of each object."""
        if nothing_is_differentiated():
            return _sum_of_runs(per_block, self.num_blocks)
        padded = torch.cat([per_block, per_block.new_zeros(1, *per_block.shape[1:])])
        of_object = self.object_blocks
        # In less time than `padded[of_object]`.
        part = padded.index_select(0, of_object.reshape(-1)).view(*of_object.shape, *per_block.shape[1:])
        # Pairwise, so that empty places change no bit.
        while part.shape[1] > 1:
            part = part[:, 0::2] + part[:, 1::2]
        return part[:, 0]


def _sum_of_runs(values: Tensor, lengths: Tensor) -> Tensor:
    """Sums (B, ...) of rows (P, ...) of which so many (B,) one after the other belong together; of none it is 0."""
    return torch.segment_reduce(values.contiguous(), "sum", lengths=lengths, unsafe=True)
