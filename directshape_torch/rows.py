"""This module packs pixels, points and what hides them, and lays out rows of residuals in blocks of one car.

Pixels are packed once, 64 of one car to a block. What a car has once (its pose, its camera's centre) is looked up per
block and not per row, the products of a block's rows have a fixed shape, and a car that leaves the batch takes its
blocks along without a row being moved. The blocks are the last axis but one of tensors: (..., M, R).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from directshape_torch.numerics.records import Dense
from directshape_torch.numerics.tables import Chosen, Table
from directshape_torch.numerics.tensors import occurrences

BLOCK = 64
"""A block has this many rows."""
LEAST_DIRECTION = 1e-12
"""This number replaces components of directions that are nearer to 0."""


@dataclass(frozen=True)
class PixelSamples(Table):
    """`PixelSamples` are P pixels of one image side, sorted by object."""

    object_index: Annotated[Tensor, Dense("P", numbers_of="B")]  # ascending
    uv: Annotated[Tensor, Dense("P", 2)]  # pixels
    origin_cam: Annotated[Tensor, Dense("P", 3)]  # centre of the pixel's own camera, in the left camera frame, metres
    ray_cam: Annotated[Tensor, Dense("P", 3)]  # of unit depth in the pixel's own camera, in the left camera frame
    foreground: Annotated[Tensor, Dense("P")]  # probability in [0, 1] of the mask at the pixel
    gradient_magnitude: Annotated[Tensor, Dense("P")]  # grey levels per pixel
    bias_px: Annotated[Tensor, Dense("P")]  # residual disparity at the left pixel, zero without a field
    vertical_px: Annotated[Tensor, Dense("P")]  # residual row offset at the left pixel, zero without a field

    def __len__(self) -> int:
        return len(self.object_index)


@dataclass(frozen=True)
class PointSamples(Table):
    """`PointSamples` are P points of B cars, sorted by object."""

    object_index: Annotated[Tensor, Dense("P", numbers_of="B")]  # ascending
    points_cam: Annotated[Tensor, Dense("P", 3)]  # metres
    # points that passed the filters, before the reduction to `max_points`
    counts: Annotated[Tensor, Dense("B", kind="index")]


@dataclass(frozen=True)
class OcclusionMap:
    """An `OcclusionMap` says how far in front the foremost instance at each pixel of one image side is.

    There are two numbers: the depth, metres, for instances of known depth, and minus the lower edge of the left 2D box,
    pixels, for other instances.
    """

    # (N, 6) integer, for each detection of the call: u0, v0, u1, v1 of the box around all masks, half open; the entry
    # of `covering` that pixel (0, 0) of the frame would have; the number of entries from one row of pixels to the next
    crop: Tensor
    in_front: Tensor  # (N, 2) numbers below which an instance is in front of each detection
    covering: Tensor  # (A, 2) least numbers of the instances that cover each pixel, infinity where none does

    def at(
        self,
        object_index: Tensor,  # (...)
        uv: Tensor,  # (..., 2)
    ) -> Tensor:
        """Whether (...) an instance in front of the object covers the pixel next to each point; NaN is never hidden."""
        if uv.is_floating_point():
            # The bound is far beyond any image, but within the integers.
            uv = uv.round().nan_to_num(nan=-1.0, posinf=-1.0, neginf=-1.0).clamp(-1.0, 2.0**30)
        u, v = uv.long().unbind(-1)
        u0, v0, u1, v1, first, step = self.crop[object_index].unbind(-1)
        inside = (u >= u0) & (u < u1) & (v >= v0) & (v < v1)
        covering = self.covering[torch.where(inside, first + v * step + u, 0)]
        return (covering < self.in_front[object_index]).any(dim=-1) & inside


class Blocks(NamedTuple):
    """`Blocks` are M blocks of B cars; the blocks of a car may lie apart.

    The host knows how many blocks each car has, so that it need not wait for the device when cars are left out.
    """

    owner: Annotated[Tensor, Dense("M", numbers_of="B")]  # car of each block
    counts: Annotated[tuple[int, ...], Dense("B")]  # number of blocks of each car

    @classmethod
    def one_each(cls, num_cars: int, device: torch.device) -> Blocks:
        """One block of every car."""
        return cls(torch.arange(num_cars, device=device), (1,) * num_cars)

    @classmethod
    def join(cls, parts: Sequence[Blocks]) -> Blocks:
        """The blocks of all parts, which belong to the same cars, one part after the other."""
        counts = tuple(map(sum, zip(*(part.counts for part in parts), strict=True)))
        return cls(torch.cat([part.owner for part in parts]), counts)

    def kept(self, cars: Chosen) -> Tensor:
        """The numbers (R,) of the blocks of some cars."""
        return torch.nonzero_static(cars.keep[self.owner], size=sum(self.counts[n] for n in cars.numbers))[:, 0]


class Rows(NamedTuple):
    """`Rows` say how packed rows, sorted by car, fill blocks."""

    blocks: Blocks
    # row in each place; an empty place repeats a row of its own car
    row: Annotated[Tensor, Dense("M", BLOCK, numbers_of="P")]
    filled: Annotated[Tensor, Dense("M", BLOCK, kind="flags")]  # which places are filled
    rows_of_car: Annotated[tuple[int, ...], Dense("B")]  # number of rows of each car, as the host knows it

    @classmethod
    def of_sorted(cls, car: Tensor, num_cars: int) -> Rows:
        """Blocks of rows whose cars (P,) ascend.

        Examples:
            >>> rows = Rows.of_sorted(torch.tensor([0, 0, 2]), 3)
            >>> rows.blocks.owner, rows.row[:, :3]
            (tensor([0, 2]), tensor([[0, 1, 0],
                    [2, 2, 2]]))
        """
        rows_of_car = occurrences(car, num_cars)
        blocks_of_car = (rows_of_car + BLOCK - 1) // BLOCK
        num_rows, counts = (tuple(numbers) for numbers in torch.stack([rows_of_car, blocks_of_car]).tolist())
        cars = torch.arange(num_cars, device=car.device)
        owner = torch.repeat_interleave(cars, blocks_of_car, output_size=sum(counts))
        first_row, first_block = (torch.cumsum(n, 0) - n for n in (rows_of_car, blocks_of_car))
        block_in_car = torch.arange(len(owner), device=car.device) - first_block[owner]
        place = block_in_car[:, None] * BLOCK + torch.arange(BLOCK, device=car.device)
        filled = place < rows_of_car[owner][:, None]
        # An empty place must not bring another car's numbers, which may be NaN, nor an index out of range.
        row = first_row[owner][:, None] + torch.where(filled, place, place[:, :1])
        return cls(Blocks(owner, counts), row, filled, num_rows)

    @property
    def places(self) -> Tensor:
        """Place (P,) of each row among the M * 64 of all blocks."""
        return torch.nonzero_static(self.filled.flatten(), size=sum(self.rows_of_car))[:, 0]


class CarSums(NamedTuple):
    """`CarSums` fix the order in which blocks of a car are added: its sum keeps every bit whatever other cars have."""

    by_car: Tensor  # (M,) blocks of the first car in order, then of the second, ...
    first: Tensor  # (B,) where the blocks of each car begin

    @classmethod
    def of(cls, owner: Tensor, num_cars: int) -> CarSums:
        """The order of blocks that belong to the cars `owner` (M,).

        Examples:
            >>> CarSums.of(torch.tensor([0, 2, 0]), 3)
            CarSums(by_car=tensor([0, 2, 1]), first=tensor([0, 2, 2]))
        """
        ascending, by_car = owner.sort(stable=True)
        return cls(by_car, torch.searchsorted(ascending, torch.arange(num_cars, device=owner.device)))

    def sum(self, table: Tensor, weight: Tensor | None = None) -> Tensor:
        """Sums (B, ...) of the entries (M, ...) of each car, times weights (M,); no entry enters another car's sum.

        Examples:
            >>> CarSums.of(torch.tensor([0, 2, 0]), 3).sum(torch.tensor([1.0, 2.0, 4.0]))
            tensor([5., 0., 2.])
        """
        weight = None if weight is None else weight[self.by_car]
        flat = table[:, None] if table.ndim == 1 else table.flatten(1)
        # This lookup in a table adds rows as it reads them, and writes only the sums.
        sums = torch.nn.functional.embedding_bag(self.by_car, flat, self.first, mode="sum", per_sample_weights=weight)
        return sums.view(len(self.first), *table.shape[1:])


class Rays(NamedTuple):
    """`Rays` are the rays of blocks in the left camera's frame; each block has one camera and one car."""

    owner: Annotated[Tensor, Dense("M", numbers_of="B")]  # car
    centre_cam: Annotated[Tensor, Dense("M", 3)]  # centre of the pixels' own camera, metres
    ray_cam: Annotated[Tensor, Dense(3, "M", "R")]  # directions of unit depth in the pixels' own camera

    @classmethod
    def of_rows(cls, rows: Rows, centre_cam: Tensor, ray_cam: Tensor) -> Rays:
        """The rays of blocks, from camera centres and rays (P, 3) of packed rows."""
        return cls(rows.blocks.owner, centre_cam[rows.row[:, 0]], ray_cam[rows.row].movedim(-1, 0).contiguous())

    def in_objects(self, T_obj_cam: Tensor) -> ObjectRays:
        """The rays in the frames of their cars, by the poses (B, 4, 4) of the cars."""
        # These are the columns of R and the translation, (3, M, 1) each. Each coordinate is contiguous in memory, and
        # so are results; otherwise each operation would go through memory in runs of 64.
        x_axis, y_axis, z_axis, moved = T_obj_cam[self.owner, :3].permute(2, 1, 0).contiguous()[..., None].unbind(0)
        (cx, cy, cz), (x, y, z) = self.centre_cam.mT[..., None].unbind(0), self.ray_cam.unbind(0)
        centre = torch.addcmul(torch.addcmul(torch.addcmul(moved, x_axis, cx), y_axis, cy), z_axis, cz)
        direction = torch.addcmul(torch.addcmul(x_axis * x, y_axis, y), z_axis, z)
        return ObjectRays(centre, direction)


class ObjectRays(NamedTuple):
    """`ObjectRays` are rays in their car's frame: `point_obj = centre + depth * direction`, depth in their camera."""

    centre_obj: Tensor  # (3, M, 1) metres
    direction_obj: Tensor  # (3, M, R) per metre of depth

    def at(self, depth: Tensor) -> Tensor:
        """Points (3, ..., M, R) at depths (..., M, R)."""
        centre, direction = self.centre_obj, self.direction_obj
        for _ in range(depth.ndim - 2):
            centre, direction = centre[:, None], direction[:, None]
        return torch.addcmul(centre, depth, direction)

    def depth_next_to(self, points_obj: Tensor) -> Tensor:
        """Depths (M, R) at which the rays come closest to points (3, M, R)."""
        along = ((points_obj - self.centre_obj) * self.direction_obj).sum(0)
        return along / (self.direction_obj * self.direction_obj).sum(0)

    def interval(self, bounds_obj: Tensor) -> Interval:
        """The depths between which rays are inside bounds (2, 3) and in front of their camera."""
        direction = self.direction_obj
        inverse = 1 / torch.copysign(direction.abs().clamp_min(LEAST_DIRECTION), direction)
        to_lower, to_upper = (bounds_obj[..., None, None] - self.centre_obj) * inverse
        enters, leaves = torch.minimum(to_lower, to_upper), torch.maximum(to_lower, to_upper)
        near, far = enters.amax(0).clamp_min(0), leaves.amin(0)
        hit = far > near
        near = torch.where(hit, near, 1.0)
        return Interval(near, torch.where(hit, far, near + 1), hit, enters, leaves)


class Interval(NamedTuple):
    """An `Interval` says where rays (M, R) are inside bounds; rays that miss have finite depths without meaning."""

    near: Tensor  # (M, R) metres of depth
    far: Tensor  # (M, R)
    hit: Tensor  # (M, R) bool
    enters: Tensor  # (3, M, R) depth at which the ray comes between the two bounds of each axis
    leaves: Tensor  # (3, M, R) depth at which the ray leaves the space between the two bounds of each axis
