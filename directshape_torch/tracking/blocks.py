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


class ObjectSums(NamedTuple):
    """What the blocks of each object add up to, float64."""

    cost: Tensor  # (B,)
    gradient: Tensor  # (B, D)
    hessian: Tensor  # (B, D, D)

    def of_first(self, num_objects: int) -> ObjectSums:
        """Those of the first so many objects."""
        return ObjectSums(*(x[:num_objects] for x in self))


def object_sums(
    weight: Tensor,  # (M,) of each block
    of_object: Tensor,  # (B, W) of `Blocks`, or the table of them that compiled code takes
    cost: Tensor,  # (M,) float64
    products: Tensor,  # (M, D + 1, D) of `weighted_products`
) -> ObjectSums:
    """Weighted sums over the blocks of each object, which do not depend on how many blocks the others have."""
    if torch.compiler.is_compiling():
        return sums_by_table(weight, of_object, cost, products)
    _, rows, unknowns = products.shape
    both = torch.cat([products.flatten(1), cost[:, None]], dim=1) * weight[:, None]
    total = sum_over_blocks(both, of_object.flatten(1))
    matrix = total[:, :-1].reshape(-1, rows, unknowns)
    return ObjectSums(total[:, -1], matrix[:, -1], matrix[:, :-1])


# Blocks that compiled code adds in one expression.
_ADDENDS = 8


def table_to_compile(of_object: Tensor, num_blocks: int) -> Tensor:
    """`Blocks.of_object` (B, W) of M blocks as compiled sums take it: (B, V, 8), with at least two rows and columns.

    Sizes below two would be compilations of their own. Rows that are added stand for objects without blocks.
    """
    num_objects, width = of_object.shape
    missing = max(2 * _ADDENDS - width, 0), max(2 - num_objects, 0)
    if any(missing):
        of_object = torch.nn.functional.pad(of_object, (0, missing[0], 0, missing[1]), value=num_blocks)
    return of_object.view(len(of_object), -1, _ADDENDS)


def sums_by_table(weight: Tensor, table: Tensor, cost: Tensor, products: Tensor) -> ObjectSums:
    """`object_sums` by a table (B, V, 8), in the form in which compiled code is fast: nothing but sums is written."""
    matrix = _sum_by_table(weight, table, products)
    return ObjectSums(_sum_by_table(weight, table, cost), matrix[:, -1], matrix[:, :-1])


def _sum_by_table(weight: Tensor, table: Tensor, per_block: Tensor) -> Tensor:
    parts = []
    for block in table.unbind(2):
        filled = block < len(weight)
        block = torch.where(filled, block, 0)
        column = (*block.shape, *(1,) * (per_block.ndim - 1))
        part = per_block[block].to(torch.float64) * weight[block].view(column)
        parts.append(torch.where(filled.view(column), part, torch.zeros_like(part)))
    # By pairs, as in `sum_over_blocks`: empty places between the parts of an object change no bit.
    while len(parts) > 1:
        parts = [a + b for a, b in zip(parts[0::2], parts[1::2], strict=True)]
    return parts[0].sum(dim=1)


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
