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


class BlockParts(NamedTuple):
    """What each of M blocks adds to the sums of its object, float64."""

    cost: Tensor  # (M,)
    products: Tensor  # (M, D + 1, D) of `weighted_products`


class Blocks(NamedTuple):
    """M blocks of B objects, an object's not necessarily side by side.

    The host knows how many blocks each object has, so that leaving objects out makes it wait for nothing.
    """

    owner: Tensor  # (M,) object of each block
    counts: tuple[int, ...]  # (B,) of each object

    @classmethod
    def one_each(cls, num_objects: int, device: torch.device) -> Blocks:
        """One block of every object."""
        return cls(torch.arange(num_objects, device=device), (1,) * num_objects)

    @classmethod
    def join(cls, parts: Sequence[Blocks]) -> Blocks:
        """Blocks of the same objects, those of the parts one after the other."""
        counts = tuple(map(sum, zip(*(part.counts for part in parts), strict=True)))
        return cls(torch.cat([part.owner for part in parts]), counts)

    def of_sides(self, num_sides: int) -> Blocks:
        """Blocks of objects that were numbered on from image to image, as blocks of the objects themselves.

        Example:
            >>> Blocks(torch.tensor([0, 1, 1, 3]), (1, 2, 0, 1)).of_sides(2)
            Blocks(owner=tensor([0, 1, 1, 1]), counts=(1, 3))
        """
        count = len(self.counts) // num_sides
        sides = (self.counts[side * count : (side + 1) * count] for side in range(num_sides))
        return Blocks(self.owner % max(count, 1), tuple(map(sum, zip(*sides, strict=True))))

    def of_objects(self, keep: Tensor, numbers: Sequence[int]) -> tuple[Blocks, Tensor]:
        """The blocks of the objects where `keep` (B,) holds, renumbered, and which (R,) of the blocks they are.

        Args:
            keep: (B,) bool.
            numbers: where it holds, as the host knows it.
        """
        counts = tuple(self.counts[number] for number in numbers)
        kept = torch.nonzero_static(keep[self.owner], size=sum(counts))[:, 0]
        new_object = torch.cumsum(keep.long(), 0) - 1
        return Blocks(new_object[self.owner[kept]], counts), kept


class WeightedBlocks(NamedTuple):
    """Blocks in the order in which they are added, with the weights of their parts."""

    by_object: Tensor  # (M,) blocks of the first object in order, then of the second, ...
    first: Tensor  # (B,) where those of each object begin
    weight: Tensor  # (M,) float64, in that order

    @classmethod
    def of(cls, blocks: Blocks, weight: Tensor) -> WeightedBlocks:
        """Blocks with a weight (M,) for each, float64.

        Example:
            >>> blocks = WeightedBlocks.of(Blocks(torch.tensor([0, 2, 0]), (2, 0, 1)), torch.tensor([0.1, 0.2, 0.3]))
            >>> blocks.by_object, blocks.first, blocks.weight
            (tensor([0, 2, 1]), tensor([0, 2, 2]), tensor([0.1000, 0.3000, 0.2000]))
        """
        ascending, by_object = blocks.owner.sort(stable=True)
        objects = torch.arange(len(blocks.counts), device=blocks.owner.device)
        return cls(by_object, torch.searchsorted(ascending, objects), weight[by_object])

    def sums(self, parts: Sequence[BlockParts]) -> ObjectSums:
        """Weighted sums over the blocks of each object, block after block: whatever the other objects have.

        Args:
            parts: of the blocks, those of one kind of rows after the other's.
        """
        cost, products = (torch.cat(of_kinds) for of_kinds in zip(*parts, strict=True))
        gradient_and_hessian = self._sum(products.flatten(1)).view(-1, *products.shape[1:])
        return ObjectSums(self._sum(cost.unsqueeze(1))[:, 0], gradient_and_hessian[:, -1], gradient_and_hessian[:, :-1])

    def _sum(self, table: Tensor) -> Tensor:
        """Sums (B, n) of the rows (M, n) of each object."""
        # A lookup in a table of rows, which are added as they are read: nothing but the sums is written.
        return torch.nn.functional.embedding_bag(
            self.by_object, table, self.first, mode="sum", per_sample_weights=self.weight
        )


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
        return cls(Blocks(cut.owner, cut.known_num_blocks), rows, filled)


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
