"""Rows in blocks of 64 that belong to one object each: the layout of everything that is summed per object.

What an object has once (its T_obj_cam, its camera's centre) is looked up per block and not per row, the products of a
block's rows have a fixed shape, and an object that leaves the batch takes its blocks along without a row being moved.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.solver.normal_equations import Segments, sum_over_blocks


class Blocks(NamedTuple):
    """M blocks of B objects.

    An object's blocks need not lie side by side. `of_object` is (B, W), W a power of two, M standing for no block. The
    host knows how many blocks each object has, so that leaving objects out makes it wait for nothing.
    """

    owner: Tensor  # (M,) object of each block
    of_object: Tensor  # (B, W) blocks of each object, in order
    counts: tuple[int, ...]  # (B,) of each object

    @classmethod
    def join(cls, parts: list[Blocks]) -> Blocks:
        """Blocks of the same objects, those of the 2^n parts one after the other.

        Each part gets the same number of places, so that the pairs of the sums do not depend on the other objects.
        """
        total = sum(len(part.owner) for part in parts)
        width = max(part.of_object.shape[1] for part in parts)
        places, before = [], 0
        for part in parts:
            inside = part.of_object < len(part.owner)
            place = torch.where(inside, part.of_object + before, total)
            places.append(torch.nn.functional.pad(place, (0, width - place.shape[1]), value=total))
            before += len(part.owner)
        counts = tuple(map(sum, zip(*(part.counts for part in parts), strict=True)))
        return cls(torch.cat([part.owner for part in parts]), torch.cat(places, dim=1), counts)

    def of_objects(self, keep: Tensor, numbers: Sequence[int]) -> tuple[Blocks, Tensor]:
        """The blocks of the objects where `keep` (B,) holds, renumbered, and which (R,) of the blocks they are.

        Args:
            keep: (B,) bool.
            numbers: where it holds, as the host knows it.
        """
        counts = tuple(self.counts[number] for number in numbers)
        objects = torch.nonzero_static(keep, size=len(counts))[:, 0]
        kept = torch.nonzero_static(keep[self.owner], size=sum(counts))[:, 0]
        new_object = torch.cumsum(keep.long(), 0) - 1
        new_block = torch.full((len(self.owner) + 1,), len(kept), dtype=torch.long, device=kept.device)
        new_block.index_copy_(0, kept, torch.arange(len(kept), device=kept.device))
        return Blocks(new_object[self.owner[kept]], new_block[self.of_object[objects]], counts), kept

    def sums(self, weight: Tensor, cost: Tensor, products: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Weighted sums over the blocks of each object.

        Args:
            weight: (M,) of each block.
            cost: (M,).
            products: (M, D + 1, D) of `weighted_products`.

        Returns:
            Cost (B,), gradient (B, D) and Gauss-Newton matrix (B, D, D).
        """
        _, rows, unknowns = products.shape
        both = torch.cat([products.flatten(1), cost[:, None]], dim=1) * weight[:, None]
        total = sum_over_blocks(both, self.of_object)
        of_object = total[:, :-1].reshape(-1, rows, unknowns)
        return total[:, -1], of_object[:, -1], of_object[:, :-1]


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
        segments = Segments.from_sorted_index(object_index, num_objects)
        filled = segments.block_rows < len(object_index)
        # An empty place must not bring another object's numbers, which may be NaN, nor an index out of range.
        rows = torch.where(filled, segments.block_rows, segments.block_rows[:, :1])
        owner = object_index[rows[:, 0]]
        counts = tuple(torch.bincount(owner, minlength=num_objects).tolist())
        return cls(Blocks(owner, segments.object_blocks, counts), rows, filled)


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
