"""Both silhouette terms of a stage in the form that is followed from iteration to iteration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.energy.fixed_rows import FixedRows
from directshape_torch.energy.projected_state import ProjectedState, ProjectedView
from directshape_torch.energy.silhouette_term import SilhouetteTerm
from directshape_torch.tracking.blocks import BlockParts, Blocks, PackedBlocks
from directshape_torch.tracking.field import BlockField
from directshape_torch.tracking.rays import BlockRays
from directshape_torch.tracking.silhouette import (
    SilhouetteRows,
    SilhouetteSums,
    accumulate_silhouettes,
    closest_depth,
    linearise_silhouettes,
    silhouette_residuals,
)

# A ray is near the contour where |zeta sdf| is below this: beyond, its slope is at most 4 % of the steepest.
IN_PLAY_EXPONENT = 8.0
# And as far again as the contour may move during a stage, beyond which the next stage picks it up.
_IN_PLAY_MARGIN_M = 0.2
# Where a wider contour has gone before, what is left to move is little: no more than a narrow contour's own reach.
_MARGIN_EXPONENT_AFTER_WIDER = 10.0


@dataclass
class TrackedSilhouettes:
    """Rows of both sides and the points that they follow.

    Attributes:
        blocks: M blocks of B objects.
        rows: what an evaluation needs.
        weight: (M,) float64, of the term and of the object.
        constant: (B,) float64, cost of the rays that are not near a contour.
        anchor_obj: (3, M, 64) where each ray was closest at the state of its object.
        latest: (3, M, 64) where it was at the latest evaluation.
    """

    blocks: Blocks
    rows: SilhouetteRows
    weight: Tensor
    constant: Tensor
    anchor_obj: Tensor
    latest: Tensor | None = None

    @classmethod
    def of_terms(
        cls,
        terms: Sequence[SilhouetteTerm],
        projected: ProjectedState,
        factors: Sequence[Tensor | None],
        after_wider: bool = False,
    ) -> TrackedSilhouettes:
        """From the two terms of a stage at the state where it begins, and factors (B,) of their weights.

        `after_wider`: an earlier stage had a wider contour, so that this one has less to move.
        """
        pairs = zip(terms, factors, strict=True)
        sides = [_side(term, term.view(projected), factor, after_wider) for term, factor in pairs]
        rows = [side.rows for side in sides]
        rays = [r.rays for r in rows]
        joined = SilhouetteRows(
            rays=BlockRays(
                torch.cat([r.owner for r in rays]),
                torch.cat([r.centre_cam for r in rays]),
                torch.cat([r.ray_cam for r in rays], dim=1),
            ),
            zeta=torch.cat([r.zeta for r in rows]),
            foreground=torch.cat([r.foreground for r in rows]),
            filled=torch.cat([r.filled for r in rows]),
            bounds_obj=rows[0].bounds_obj,
            saturation=rows[0].saturation,
            residual_floor=rows[0].residual_floor,
        )
        return cls(
            blocks=Blocks.join([side.blocks for side in sides]),
            rows=joined,
            weight=torch.cat([side.weight for side in sides]),
            constant=torch.stack([side.constant for side in sides]).sum(dim=0),
            anchor_obj=torch.cat([side.anchor_obj for side in sides], dim=1),
        )

    def linearise(self, field: BlockField, T_obj_cam: Tensor) -> BlockParts:
        """What blocks add to cost, gradient and Gauss-Newton matrix at poses (B, 4, 4), with hand-derived Jacobians."""
        return self._noted(linearise_silhouettes(field, self.rows, self._of_blocks(T_obj_cam), self.anchor_obj))

    def fixed_depths(self, field: BlockField, T_obj_cam: Tensor) -> tuple[Tensor, Tensor]:
        """Depths (M, 64) of closest approach at a state, and which rays cross the bounds."""
        return closest_depth(field, self.rows, self.rows.rays.in_objects(self._of_blocks(T_obj_cam)), self.anchor_obj)

    def residuals(self, field: BlockField, T_obj_cam: Tensor, fixed: tuple[Tensor, Tensor]) -> Tensor:
        """Residuals (M, 64) at fixed depths, differentiable."""
        return silhouette_residuals(field, self.rows, self._of_blocks(T_obj_cam), *fixed)

    def accumulate(self, residual: Tensor, J: Tensor, T_obj_cam: Tensor, fixed: tuple[Tensor, Tensor]) -> BlockParts:
        """The same with any Jacobian (M, 64, D) of the residuals."""
        depth, crosses = fixed
        points = self.rows.rays.in_objects(self._of_blocks(T_obj_cam)).at(depth)
        J = torch.where(crosses[..., None], J, torch.zeros_like(J))
        sums = accumulate_silhouettes(self.rows, residual, J, torch.where(crosses, points, self.anchor_obj))
        return self._noted(sums)

    def fixed_rows(self, field: BlockField, T_obj_cam: Tensor) -> FixedRows:
        """With what Jacobians at a state hold constant: depths, and which rays cross the bounds."""
        fixed = self.fixed_depths(field, T_obj_cam)
        return FixedRows(
            lambda at, T: self.residuals(at, T, fixed),
            lambda residual, J: self.accumulate(residual, J, T_obj_cam, fixed),
        )

    def follow(self, accepted: Tensor) -> None:
        """The objects (B,) that are now at the state of the latest evaluation."""
        if self.latest is not None:
            self.anchor_obj = torch.where(accepted[self.blocks.owner][:, None], self.latest, self.anchor_obj)

    def of_objects(self, keep: Tensor, numbers: Sequence[int]) -> TrackedSilhouettes:
        """Those of the objects where `keep` (B,) holds: `numbers` of them, as the host knows them."""
        blocks, kept = self.blocks.of_objects(keep, numbers)
        rows = self.rows.select(kept, blocks.owner)
        constant = self.constant.index_select(0, torch.nonzero_static(keep, size=len(numbers))[:, 0])
        return TrackedSilhouettes(blocks, rows, self.weight[kept], constant, self.anchor_obj[:, kept])

    def _of_blocks(self, T_obj_cam: Tensor) -> Tensor:
        return self.rows.rays.of_blocks(T_obj_cam)

    def _noted(self, sums: SilhouetteSums) -> BlockParts:
        self.latest = sums.points_obj
        return BlockParts(sums.cost, sums.products)


class _Side(NamedTuple):
    """One image's part of `TrackedSilhouettes`."""

    blocks: Blocks
    rows: SilhouetteRows
    weight: Tensor
    constant: Tensor
    anchor_obj: Tensor


def _side(term: SilhouetteTerm, view: ProjectedView, factor: Tensor | None, after_wider: bool) -> _Side:
    """The rays of one term that are near its contours."""
    crosses = view.march.crosses_bounds
    margin = _IN_PLAY_MARGIN_M * term.zeta
    if after_wider:
        margin = margin.clamp_max(_MARGIN_EXPONENT_AFTER_WIDER)
    in_play = (view.closest_sdf.abs() * term.zeta < IN_PLAY_EXPONENT + margin) | ~crosses
    weight = term.weight() if factor is None else term.weight() * factor.to(torch.float64)
    at_rest = torch.where(in_play, torch.zeros_like(term.zeta), term.residual_at(view))
    chosen = in_play.nonzero()[:, 0]
    pixels = term.pixels.select(chosen)
    packed = PackedBlocks.of_sorted(pixels.object_index, len(weight))
    rows = SilhouetteRows(
        rays=BlockRays.of_pixels(pixels, packed),
        zeta=term.zeta[chosen][packed.rows[:, :1]],
        foreground=term.foreground[chosen][packed.rows],
        filled=packed.filled,
        bounds_obj=view.bounds_obj,
        saturation=term.config.saturation,
        residual_floor=term.config.residual_floor,
    )
    # A ray that misses the bounds has no closest point yet; should it come in, it will come by the middle.
    middle = view.bounds_obj.mean(dim=0)
    direction = view.rays.direction_obj
    by_the_middle = ((middle - view.rays.origin_obj) * direction).sum(-1) / (direction * direction).sum(-1)
    points = view.rays.at(torch.where(crosses, view.closest_depth, by_the_middle))
    anchor = points[chosen][packed.rows].movedim(-1, 0).contiguous()
    constant = term.segments.sum(at_rest) * weight
    return _Side(packed.blocks, rows, weight[packed.blocks.owner], constant, anchor)
