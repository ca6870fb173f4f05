"""Rows in blocks of 64 that belong to one object each: the layout of everything that is summed per object.

What an object has once (its T_obj_cam, its camera's centre) is looked up per block and not per row, the products of a
block's rows have a fixed shape, and an object that leaves the batch takes its blocks along without a row being moved.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.solver.normal_equations import RowBlocks


class ObjectSums(NamedTuple):
    """What the blocks of each object add up to, float64."""

    cost: Tensor  # (B,)
    gradient: Tensor  # (B, D)
    hessian: Tensor  # (B, D, D)


class Blocks(NamedTuple):
    """M blocks of B objects, an object's not necessarily side by side.

    The host knows how many blocks each object has, so that leaving objects out makes it wait for nothing.
    """

    owner: Tensor  # (M,) object of each block
    by_object: Tensor  # (M,) blocks of the first object in order, then of the second, ...
    first: Tensor  # (B,) where those of each object begin
    counts: tuple[int, ...]  # (B,) of each object

    @classmethod
    def of_owners(cls, owner: Tensor, counts: tuple[int, ...]) -> Blocks:
        """Blocks of objects (M,), and how many each object has.

        Example:
            >>> blocks = Blocks.of_owners(torch.tensor([0, 2, 0]), (2, 0, 1))
            >>> blocks.by_object, blocks.first
            (tensor([0, 2, 1]), tensor([0, 2, 2]))
        """
        ascending, by_object = owner.sort(stable=True)
        objects = torch.arange(len(counts), device=owner.device)
        return cls(owner, by_object, torch.searchsorted(ascending, objects), counts)

    @classmethod
    def join(cls, parts: list[Blocks]) -> Blocks:
        """Blocks of the same objects, those of the parts one after the other."""
        counts = tuple(map(sum, zip(*(part.counts for part in parts), strict=True)))
        return cls.of_owners(torch.cat([part.owner for part in parts]), counts)

    def of_objects(self, keep: Tensor, numbers: Sequence[int]) -> tuple[Blocks, Tensor]:
        """The blocks of the objects where `keep` (B,) holds, renumbered, and which (R,) of the blocks they are.

        Args:
            keep: (B,) bool.
            numbers: where it holds, as the host knows it.
        """
        counts = tuple(self.counts[number] for number in numbers)
        kept = torch.nonzero_static(keep[self.owner], size=sum(counts))[:, 0]
        new_object = torch.cumsum(keep.long(), 0) - 1
        return Blocks.of_owners(new_object[self.owner[kept]], counts), kept

    def sums(self, weight: Tensor, cost: Tensor, products: Tensor) -> ObjectSums:
        """Weighted sums over the blocks of each object, block after block: whatever the other objects have.

        Args:
            weight: (M,) of each block, float64.
            cost: (M,), float64.
            products: (M, D + 1, D) of `weighted_products`.
        """
        _, rows, unknowns = products.shape
        both = torch.cat([products.flatten(1), cost[:, None]], dim=1)
        # A lookup in a table of rows, which are added as they are read: nothing but the sums is written.
        total = torch.nn.functional.embedding_bag(
            self.by_object, both, self.first, mode="sum", per_sample_weights=weight[self.by_object]
        )
        of_object = total[:, :-1].reshape(-1, rows, unknowns)
        return ObjectSums(total[:, -1], of_object[:, -1], of_object[:, :-1])


class PackedBlocks(NamedTuple):
    """How packed rows fill their blocks."""

    blocks: Blocks
    rows: Tensor  # (M, 64) row in each place; an empty place repeats a row of its own object
    filled: Tensor  # (M, 64) bool

    @classmethod
    def of_sorted(cls, object_index: Tensor, num_objects: int) -> PackedBlocks:
        """Blocks of rows whose objects (P,) ascend.

        Example:
            >>> packed = PackedBlocks.of_sorted(torch.tensor([0, 0, 2]), 3)
            >>> packed.blocks.owner, packed.rows[:, :3]
            (tensor([0, 2]), tensor([[0, 1, 0],
                    [2, 2, 2]]))
        """
        return cls.of_rows(RowBlocks.of_sorted(object_index, num_objects))

    @classmethod
    def of_rows(cls, cut: RowBlocks) -> PackedBlocks:
        """Of rows that are cut into blocks already."""
        filled = cut.block_rows < len(cut.object_index)
        # An empty place must not bring another object's numbers, which may be NaN, nor an index out of range.
        rows = torch.where(filled, cut.block_rows, cut.block_rows[:, :1])
        return cls(Blocks.of_owners(cut.owner, tuple(cut.num_blocks.tolist())), rows, filled)


def weighted_products(
    J: Tensor,  # (M, 64, D)
    gradient_weight: Tensor,  # (M, 64)
    hessian_weight: Tensor,  # (M, 64)
) -> Tensor:  # (M, D + 1, D)
    """`sum w_H J^T J` of each block and, as one more row, `sum w_g J`; float64.

    A block's 64 rows are summed in the rows' own precision, the blocks of an object in float64.
    """
    weighted = torch.cat([J * hessian_weight[..., None], gradient_weight[..., None]], dim=-1)
    return torch.bmm(weighted.mT, J).to(torch.float64)
