"""The photometric term of a stage in the form that is followed from iteration to iteration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.energy.fixed_rows import FixedRows
from directshape_torch.energy.photometric_term import PhotometricTerm
from directshape_torch.energy.projected_state import ProjectedState
from directshape_torch.tracking.blocks import BlockParts, Blocks, PackedBlocks
from directshape_torch.tracking.field import BlockField, block_field
from directshape_torch.tracking.photometric import (
    Hits,
    PhotometricRows,
    PhotometricSettings,
    PhotometricSums,
    Residual,
    RightView,
    Surface,
    accumulate_photometric,
    depth_of_state,
    linearise_photometric,
    photometric_residuals,
    surface_under,
)
from directshape_torch.tracking.rays import BlockRays

# Beyond every object that is ever seen.
_FAR_M = 1e4


class FixedSurface(NamedTuple):
    """The surface of a state and which of its pixels count."""

    surface: Surface
    usable: Tensor  # (M, 64) bool


@dataclass
class TrackedPhotometric:
    """Rows of the pixel set and the surface hits that they follow.

    Attributes:
        blocks: M blocks of B objects.
        rows: what an evaluation needs.
        settings: numbers of the configuration.
        weight: (M,) float64, of the term and of the object.
        hits: at the state of each object.
        latest: at the latest evaluation.
    """

    blocks: Blocks
    rows: PhotometricRows
    settings: PhotometricSettings
    weight: Tensor
    hits: Hits
    latest: Hits | None = None

    @classmethod
    def of_term(cls, term: PhotometricTerm, projected: ProjectedState, factor: Tensor | None) -> TrackedPhotometric:
        """From the term of a stage at the state where it begins, and a factor (B,) of its weight."""
        config, fixed = term.config, term.pixel_set
        packed = PackedBlocks.of_rows(fixed.segments)
        settings = PhotometricSettings(
            config.huber_grey_levels,
            config.lost_grey_levels,
            config.truncated,
            config.min_ray_cosine,
            config.patch,
            config.contrast_floor_grey_levels,
        )
        weight = term.weight() if factor is None else term.weight() * factor.to(torch.float64)
        rows, hits = _rows(term, packed), _hits(term, projected, packed)
        return cls(packed.blocks, rows, settings, weight[packed.blocks.owner], hits)

    def linearise(self, field: BlockField, T_obj_cam: Tensor) -> BlockParts:
        """What blocks add to cost, gradient and Gauss-Newton matrix at poses (B, 4, 4), with hand-derived Jacobians."""
        return self._noted(
            linearise_photometric(field, self.rows, self.settings, self._of_blocks(T_obj_cam), self.hits)
        )

    def at_state(self, term: PhotometricTerm, projected: ProjectedState) -> BlockParts:
        """What the blocks of all objects of a term add at any state, with the hits of that very state."""
        field, T_obj_cam = block_field(projected.shape), self._of_blocks(projected.state.T_obj_cam)
        hits = _hits(term, projected, PackedBlocks.of_rows(term.pixel_set.segments))
        sums = linearise_photometric(field, self.rows, self.settings, T_obj_cam, hits)
        return BlockParts(sums.cost, sums.products)

    def fixed_depths(self, field: BlockField, T_obj_cam: Tensor) -> FixedSurface:
        """The surface at a state, with the set of its usable pixels."""
        surface = surface_under(field, self.rows, self.settings, self._of_blocks(T_obj_cam), self.hits)
        return FixedSurface(surface, surface.usable & self._residual(surface.depth).comparable)

    def residuals(self, field: BlockField, T_obj_cam: Tensor, fixed: FixedSurface) -> Tensor:
        """Residuals (M, 64, N), differentiable."""
        return self._residual(depth_of_state(field, self.rows, self._of_blocks(T_obj_cam), fixed.surface)).value

    def accumulate(self, residual: Tensor, J: Tensor, T_obj_cam: Tensor, fixed: FixedSurface) -> BlockParts:
        """The same with any Jacobian (M, 64, N, D) of the residuals."""
        hits = fixed.surface.hits
        return self._noted(accumulate_photometric(self.rows, self.settings, residual, J, fixed.usable, hits))

    def fixed_rows(self, field: BlockField, T_obj_cam: Tensor) -> FixedRows:
        """With what Jacobians at a state hold constant: the surface, and which pixels count."""
        fixed = self.fixed_depths(field, T_obj_cam)
        return FixedRows(
            lambda at, T: self.residuals(at, T, fixed),
            lambda residual, J: self.accumulate(residual, J, T_obj_cam, fixed),
        )

    def follow(self, accepted: Tensor) -> None:
        """The objects (B,) that are now at the state of the latest evaluation."""
        if self.latest is not None:
            moves = accepted[self.blocks.owner][:, None]
            self.hits = Hits(*(torch.where(moves, new, old) for new, old in zip(self.latest, self.hits, strict=True)))

    def of_objects(self, keep: Tensor, numbers: Sequence[int]) -> TrackedPhotometric:
        """Those of the objects where `keep` (B,) holds: `numbers` of them, as the host knows them."""
        blocks, kept = self.blocks.of_objects(keep, numbers)
        rows, hits = self.rows.select(kept, blocks.owner), Hits(*(x.index_select(1, kept) for x in self.hits))
        return TrackedPhotometric(blocks, rows, self.settings, self.weight[kept], hits)

    def _of_blocks(self, T_obj_cam: Tensor) -> Tensor:
        return self.rows.rays.of_blocks(T_obj_cam)

    def _residual(self, depth: Tensor) -> Residual:
        return photometric_residuals(self.rows, self.settings, depth)

    def _noted(self, sums: PhotometricSums) -> BlockParts:
        self.latest = Hits(sums.points_obj, sums.normal_obj)
        return BlockParts(sums.cost, sums.products)


def _rows(term: PhotometricTerm, packed: PackedBlocks) -> PhotometricRows:
    fixed = term.pixel_set
    pixels, lines = term.pixels.select(fixed.pixel_index), fixed.lines
    pixel_weight = fixed.gradient_weight[packed.rows]
    return PhotometricRows(
        rays=BlockRays.of_pixels(pixels, packed),
        along_ray=lines.along_ray[..., packed.rows],
        along_baseline=lines.along_baseline[:, 0, packed.rows],
        intensity_left=fixed.intensity_left[packed.rows].movedim(-1, 0).contiguous(),
        pixel_weight=torch.where(packed.filled, pixel_weight, torch.zeros_like(pixel_weight)),
        neighbour_weight=fixed.neighbour_weight[packed.rows].movedim(-1, 0).contiguous(),
        right=_right_view(term, packed.blocks.owner),
    )


def _right_view(term: PhotometricTerm, owner: Tensor) -> RightView:
    """What the blocks of objects (M,) are compared with."""
    images, frame = term.pixel_set.images, term.cars.frame_index[owner]
    _, height, width = images.right.shape
    last_row, last_column = (images.sizes[frame] - 1).unbind(1)
    per_level = 1 / images.scale
    to_full = images.right.new_full((len(owner), 2), per_level)
    to_full[:, 1] = 0.5 * per_level - 0.5
    return RightView(
        images.right.reshape(-1),
        torch.stack([frame * (height * width), torch.full_like(frame, width), last_column, last_row], dim=1).long(),
        to_full,
        *_hidden(term, owner),
    )


def _hidden(term: PhotometricTerm, owner: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """`crop`, `in_front` and `covering` of `RightView`."""
    hidden, row = term.hidden_right, term.cars.detection_row[owner]
    if hidden is None:
        nowhere = torch.zeros(len(owner), 6, dtype=torch.long, device=owner.device)
        return nowhere, nowhere[:, :1], nowhere.new_zeros(2, 1)
    return hidden.table[row], hidden.in_front[row], hidden.covering


def _hits(term: PhotometricTerm, projected: ProjectedState, packed: PackedBlocks) -> Hits:
    rays, root = projected.left.surface(term.pixel_set.pixel_index)
    # A pixel that has no surface at this state starts where none is near.
    points = rays.at(torch.where(root.found, root.depth, _FAR_M))
    normal = projected.left.surface_gradient(term.pixel_set.pixel_index, root)
    return Hits(*(x[packed.rows].movedim(-1, 0).contiguous() for x in (points, normal)))
