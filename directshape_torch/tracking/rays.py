"""Rays in blocks: from the cameras into the objects, and where they are inside the prior's bounds."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.geometry.rays import RayInterval, ray_box_interval
from directshape_torch.observation.packing import PixelSamples
from directshape_torch.tracking.blocks import PackedBlocks


class BlockRays(NamedTuple):
    """Rays of M blocks in the left camera's frame; each block has one camera and one object."""

    owner: Tensor  # (M,) object
    centre_cam: Tensor  # (M, 3) of the pixels' own camera
    ray_cam: Tensor  # (3, M, 64) of unit depth in that camera

    @classmethod
    def of_pixels(cls, pixels: PixelSamples, packed: PackedBlocks) -> BlockRays:
        """The rays of pixels that were packed so."""
        return cls.of_places(packed.blocks.owner, pixels.origin_cam, pixels.ray_cam, packed.rows)

    @classmethod
    def of_places(cls, owner: Tensor, centre_cam: Tensor, ray_cam: Tensor, rows: Tensor) -> BlockRays:
        """Of blocks of objects (M,) that hold rows (M, 64) of camera centres and rays (P, 3)."""
        return cls(owner, centre_cam[rows[:, 0]], ray_cam[rows].movedim(-1, 0).contiguous())

    def select(self, blocks: Tensor, owner: Tensor) -> BlockRays:
        """Some of the blocks, of objects that are numbered anew."""
        return BlockRays(owner, self.centre_cam[blocks], self.ray_cam.index_select(1, blocks))

    def of_blocks(self, T_obj_cam: Tensor) -> Tensor:
        """Poses (M, 3, 4) of the blocks from those (B, 4, 4) of the objects."""
        return T_obj_cam[self.owner, :3]

    def in_objects(self, T_obj_cam: Tensor) -> ObjectBlockRays:
        """The rays in the frames of their objects, by the poses (M, 3, 4) of the blocks."""
        centre = (T_obj_cam[:, :, :3] * self.centre_cam[:, None]).sum(-1) + T_obj_cam[:, :, 3]
        x_axis, y_axis, z_axis = T_obj_cam[:, :, :3].permute(2, 1, 0)[..., None]  # columns of R, (3, M, 1) each
        x, y, z = self.ray_cam
        direction = torch.addcmul(torch.addcmul(x_axis * x, y_axis, y), z_axis, z)
        return ObjectBlockRays(centre.mT[..., None], direction)


class ObjectBlockRays(NamedTuple):
    """Rays in the frame of their object: `point_obj = centre + depth * direction`."""

    centre_obj: Tensor  # (3, M, 1) metres
    direction_obj: Tensor  # (3, M, 64) per metre of depth

    def at(self, depth: Tensor) -> Tensor:
        """Points (3, ..., M, 64) at depths (..., M, 64)."""
        centre, direction = self.centre_obj, self.direction_obj
        for _ in range(depth.ndim - 2):
            centre, direction = centre[:, None], direction[:, None]
        return torch.addcmul(centre, depth, direction)

    def depth_next_to(self, points_obj: Tensor) -> Tensor:
        """Depths (M, 64) at which the rays come closest to points (3, M, 64)."""
        along = ((points_obj - self.centre_obj) * self.direction_obj).sum(0)
        return along / (self.direction_obj * self.direction_obj).sum(0)

    def interval(self, bounds_obj: Tensor) -> RayInterval:
        """Where the rays are inside bounds (2, 3); depths (M, 64) of those that miss them mean nothing."""
        centre = self.centre_obj.expand_as(self.direction_obj).movedim(0, -1)
        inside = ray_box_interval(centre, self.direction_obj.movedim(0, -1), bounds_obj)
        near = torch.where(inside.hit, inside.near, torch.ones_like(inside.near))
        return RayInterval(near, torch.where(inside.hit, inside.far, near), inside.hit)
