"""This module decides whether the views of a track are of one car, by their shapes and by their likeness.

The id of a tracker may pass from one car to another. A track is therefore cut in time where the cost that two shapes
save and the unlikeness of the next view are together too large. The derivation is in docs/derivations/tracks.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import torch
from torch import Tensor

from directshape_torch.refinement.problem import CarMinimum
from directshape_torch.solver.damped_solve import damped_step
from directshape_torch.solver.sharing import schur_complement
from directshape_torch.state.cars import CarBatch, CarState
from directshape_torch.status import is_refined
from directshape_torch.terms.photometric import PhotometricEvidence
from directshape_torch.terms.term import Prepared
from directshape_torch.tracks.next_view import NextView
from directshape_torch.tracks.state import own_and_shared

# The evidence that the sides of a cut are of two cars is twice the cost that two shapes save plus `_UNLIKE` times the
# unlikeness of the next view; up to `_MOST_EVIDENCE` they count as one car. Both were chosen on 445 cuts through
# rendered and real tracks of one car: two cuts exceed the limit, where the sky appears in the windows; the others reach
# 8.7.
_MOST_EVIDENCE, _UNLIKE = 9.0, 30.0
# Reflections change as a car turns: the likeness of a view may drop by this much per degree, up to this maximum.
_LESS_LIKE_PER_DEG, _LESS_LIKE_BY_TURNING = 0.02, 0.25
# With fewer than `_FEWEST_PIXELS` pixels, likeness is unknown. Two views are of a car that turned far, or of two, if
# their common pixels are less than `_LEAST_SHARE` of the pixels of the smaller view. Their unlikeness is then
# `_UNLIKE_WITHOUT_SHARE`, which alone does not cut a track. In 445 pairs of views of one car the least share is 0.34.
_FEWEST_PIXELS, _LEAST_SHARE, _UNLIKE_WITHOUT_SHARE = 20, 0.1, 0.2
# A mask within this distance of the border of its image counts as cut off.
_BORDER_PX = 2


Parts: TypeAlias = list[list[list[int]]]
"""`Parts` lists the parts of each track; a part lists the rows of the views of one car in the order of time."""


@dataclass(frozen=True)
class SaidOfShape:
    """`SaidOfShape` is the cost of each of B views as a quadratic in its code c: `c^T A c / 2 - b^T c`.

    The quadratic is taken where the view ended, and the pose follows the code. A view that is not trusted has A = 0 and
    b = 0, because its different end is no sign of another car. If a track is cut next to this view, the view goes with
    the later views.
    """

    A: Tensor  # (B, K, K)
    b: Tensor  # (B, K, 1)
    anything: Tensor  # (B,) bool, whether the view has a quadratic, trusted or not, and can share a shape

    @classmethod
    def at(cls, minimum: CarMinimum[CarState]) -> SaidOfShape:
        """The quadratics of B cars where each ended when refined alone."""
        hessian = minimum.after.hessian.sum(dim=1)
        nothing = torch.zeros_like(hessian[:, 0])
        _, solvable = damped_step(hessian, nothing, nothing[:, 0])
        # The gradient at a minimum is zero.
        A, _, has_any = schur_complement(hessian, nothing, *own_and_shared(minimum.end))
        trusted = torch.where(is_refined(minimum.status)[:, None, None], A, 0.0)
        return cls(trusted, trusted @ minimum.end.code.to(A)[:, :, None], solvable & has_any)

    def saved(self, views: list[int]) -> Tensor:
        """Twice the cost (V - 1,) that each cut in time saves if its two sides have different shapes."""
        index = torch.tensor(views, device=self.A.device)
        A, b = (x.index_select(0, index).cumsum(dim=0) for x in (self.A, self.b))

        def twice_least(A: Tensor, b: Tensor) -> Tensor:
            # Views without information have the minimum 0 for all codes.
            solution: Tensor = torch.linalg.solve_ex(A, b)[0].nan_to_num(0.0, 0.0, 0.0)
            return -(b * solution).sum(dim=(1, 2))

        together = twice_least(A[-1:], b[-1:])
        return together - twice_least(A[:-1], b[:-1]) - twice_least(A[-1] - A[:-1], b[-1] - b[:-1])


@torch.no_grad()
def unlikeness(term: NextView, is_cut: Tensor, prepared_end: Prepared, next_view: Tensor) -> Tensor:
    """Unlikeness (B,) of each of B views and the next one, beyond what a turning car explains; 0 if it is unknown.

    `is_cut` (B,) marks views whose mask is cut off by the border of the image.
    """
    alike, count = term.likeness(prepared_end)
    towards = torch.nn.functional.normalize(prepared_end.state.T_obj_cam[:, :3, 3], dim=1)
    turned_deg = (towards * towards[next_view]).sum(dim=1).clamp(-1, 1).arccos().rad2deg()
    explained = (_LESS_LIKE_PER_DEG * turned_deg).clamp_max(_LESS_LIKE_BY_TURNING)
    unlike = torch.where(count >= _FEWEST_PIXELS, (1 - alike - explained).clamp_min(0), 0.0)
    support = term.stereo.pixel_set.support
    support = torch.minimum(support, support[next_view])
    nothing_shared = (support >= _FEWEST_PIXELS) & (count < _LEAST_SHARE * support)
    unlike = torch.where(nothing_shared, _UNLIKE_WITHOUT_SHARE, unlike)
    # A car that the image cuts off may be placed wrongly along the cut.
    whole = ~is_cut
    return torch.where(term.next_views.exists & whole & whole[next_view], unlike, 0.0)


def is_cut_off(stereo: PhotometricEvidence) -> Tensor:
    """Whether (B,) the left, right or lower border of the left image cuts off the mask of each car."""
    left, cars = stereo.left, stereo.cars
    height, width = left.pyramid[0].sizes[cars.frame_index].unbind(1)
    u0, _, u1, v1 = left.mask_left.extents[cars.detection_row].unbind(1)
    return (u1 > u0) & ((u0 < _BORDER_PX) | (u1 > width - _BORDER_PX) | (v1 > height - _BORDER_PX))


def parts_by_shape(cars: CarBatch, says: SaidOfShape, joins: Tensor) -> Parts:
    """Return the parts of each track of B cars: rows of the views of one car, in the order of times or of frames.

    Args:
        cars: B cars with their tracks.
        says: what each car says of its shape.
        joins: (B,) bool, cars that may share a shape.
    """
    assert cars.track_id is not None
    views: dict[int, list[int]] = {}
    order = (cars.frame_index if cars.time_s is None else cars.time_s).argsort(stable=True).tolist()
    track_id, joining = cars.track_id.tolist(), joins.tolist()
    for row in order:
        if track_id[row] >= 0 and joining[row]:
            views.setdefault(track_id[row], []).append(row)
    parts, cut = [[of_track] for of_track in views.values()], True
    while cut:
        finer = cut_once(parts, says, torch.zeros_like(says.A[:, 0, 0]))
        parts, cut = finer, finer != parts
    return parts


def cut_once(parts: Parts, says: SaidOfShape, unlike: Tensor) -> Parts:
    """Return the parts, each cut in time where the evidence of two cars is largest, if it exceeds the limit.

    Each part is cut at most once, because two cars in one part also spoil the likeness of its other views. `unlike`
    (B,) is the result of `unlikeness`.
    """
    return [[piece for part in of_track for piece in _of_one_car(part, says, unlike)] for of_track in parts]


def _of_one_car(views: list[int], says: SaidOfShape, unlike: Tensor) -> list[list[int]]:
    if len(views) < 2:
        return [views]
    before_cuts = torch.tensor(views[:-1], device=unlike.device)
    evidence: list[float] = (says.saved(views) + _UNLIKE * unlike.index_select(0, before_cuts)).tolist()
    cut = max(range(len(evidence)), key=evidence.__getitem__)
    return [views[: cut + 1], views[cut + 1 :]] if evidence[cut] > _MOST_EVIDENCE else [views]
