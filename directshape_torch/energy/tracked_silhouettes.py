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
        views = [term.view(projected) for term in terms]
        weights = [_weight(term, factor) for term, factor in zip(terms, factors, strict=True)]
        count = len(weights[0])
        seen = _Seen.of(terms, views, count)
        in_play = seen.in_play(after_wider)
        chosen = in_play.nonzero()[:, 0]
        # Sides are packed as if each showed objects of its own.
        packed = PackedBlocks.of_sorted(seen.object_of_side.index_select(0, chosen), count * len(terms))
        blocks, places = packed.blocks.of_sides(len(terms)), chosen[packed.rows]
        config, bounds_obj = terms[0].config, views[0].bounds_obj
        rows = SilhouetteRows(
            rays=BlockRays.of_places(blocks.owner, seen.centre_cam, seen.ray_cam, places),
            zeta=seen.zeta[places[:, :1]],
            foreground=seen.foreground[places],
            filled=packed.filled,
            bounds_obj=bounds_obj,
            saturation=config.saturation,
            residual_floor=config.residual_floor,
        )
        anchor = seen.closest_points(chosen, bounds_obj)[packed.rows]
        return cls(
            blocks=blocks,
            rows=rows,
            weight=torch.cat(weights)[packed.blocks.owner],
            constant=_cost_at_rest(terms, views, weights, in_play),
            anchor_obj=anchor.movedim(-1, 0).contiguous(),
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
        return TrackedSilhouettes(blocks, rows, self.weight[kept], constant, self.anchor_obj.index_select(1, kept))

    def _of_blocks(self, T_obj_cam: Tensor) -> Tensor:
        return self.rows.rays.of_blocks(T_obj_cam)

    def _noted(self, sums: SilhouetteSums) -> BlockParts:
        self.latest = sums.points_obj
        return BlockParts(sums.cost, sums.products)


class _Seen(NamedTuple):
    """The P rays of all sides, those of one after the other's, at the state where a stage begins."""

    object_of_side: Tensor  # (P,) objects, numbered on from side to side
    closest_sdf: Tensor  # (P,) metres
    closest_depth: Tensor  # (P,) metres
    crosses: Tensor  # (P,) bool
    zeta: Tensor  # (P,) per metre
    foreground: Tensor  # (P,)
    origin_obj: Tensor  # (P, 3)
    direction_obj: Tensor  # (P, 3)
    centre_cam: Tensor  # (P, 3)
    ray_cam: Tensor  # (P, 3)

    @classmethod
    def of(cls, terms: Sequence[SilhouetteTerm], views: Sequence[ProjectedView], num_objects: int) -> _Seen:
        of_sides = [
            (
                term.pixels.object_index + side * num_objects,
                view.closest_sdf,
                view.closest_depth,
                view.march.crosses_bounds,
                term.zeta,
                term.foreground,
                view.rays.origin_obj,
                view.rays.direction_obj,
                term.pixels.origin_cam,
                term.pixels.ray_cam,
            )
            for side, (term, view) in enumerate(zip(terms, views, strict=True))
        ]
        return cls(*(torch.cat(parts) for parts in zip(*of_sides, strict=True)))

    def in_play(self, after_wider: bool) -> Tensor:
        """Which rays (P,) are near a contour, or may come to be."""
        margin = _IN_PLAY_MARGIN_M * self.zeta
        if after_wider:
            margin = margin.clamp_max(_MARGIN_EXPONENT_AFTER_WIDER)
        return (self.closest_sdf.abs() * self.zeta < IN_PLAY_EXPONENT + margin) | ~self.crosses

    def closest_points(self, chosen: Tensor, bounds_obj: Tensor) -> Tensor:
        """Where some of the rays (R,) are closest, (R, 3) in the frames of their objects."""
        of_rays = (self.origin_obj, self.direction_obj, self.closest_depth, self.crosses)
        origin, direction, depth, crosses = (x.index_select(0, chosen) for x in of_rays)
        # A ray that misses the bounds has no closest point yet; should it come in, it will come by the middle.
        middle = bounds_obj.mean(dim=0)
        by_the_middle = ((middle - origin) * direction).sum(-1) / (direction * direction).sum(-1)
        return torch.addcmul(origin, torch.where(crosses, depth, by_the_middle)[:, None], direction)


def _weight(term: SilhouetteTerm, factor: Tensor | None) -> Tensor:
    """Of the term for each object (B,), float64."""
    return term.weight() if factor is None else term.weight() * factor.to(torch.float64)


def _cost_at_rest(
    terms: Sequence[SilhouetteTerm], views: Sequence[ProjectedView], weights: Sequence[Tensor], in_play: Tensor
) -> Tensor:
    """Cost (B,) of the rays of all sides that are not in play (P,)."""
    sides = zip(terms, views, weights, in_play.split_with_sizes([len(term.pixels) for term in terms]), strict=True)
    costs = [
        term.segments.sum(torch.where(of_side, torch.zeros_like(term.zeta), term.residual_at(view))) * weight
        for term, view, weight, of_side in sides
    ]
    return torch.stack(costs).sum(dim=0)
