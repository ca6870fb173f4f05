"""Whether the views of a track are of one car: what each says of its shape, and whether it looks like the next.

Ids of trackers pass from one car to another: a track is cut in time where what two shapes save and how unlike the next
view looks are too much together. Derivation: docs/derivations/tracks.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import torch
from torch import Tensor

from directshape_torch.solver.damped_solve import damped_step
from directshape_torch.solver.gauss_newton import Minimum
from directshape_torch.solver.sharing import said_of_shared
from directshape_torch.state.cars import CarBatch, CarState
from directshape_torch.status import is_refined
from directshape_torch.terms.photometric import PhotometricEvidence
from directshape_torch.terms.term import Sight
from directshape_torch.tracks.next_view import NextView
from directshape_torch.tracks.state import own_and_shared

# Evidence that the sides of a cut are of two cars is twice the cost that two shapes save, and so many times how unlike
# the next view is; up to a limit they are of one car. Chosen on 445 cuts through rendered and real tracks of one car:
# two exceed it, where the sky appears in the windows, the others reach 8.7.
_MOST_EVIDENCE, _UNLIKE = 9.0, 30.0
# Reflections change as a car turns: so much less like is a view of it per degree, and at most.
_LESS_LIKE_PER_DEG, _LESS_LIKE_BY_TURNING = 0.02, 0.25
# Fewer pixels say nothing. Views that share less than this share of the pixels of the smaller one are of a car that has
# turned far, or of two: that counts as so unlike, which by itself is not enough. Of those 445 pairs the least is 0.34.
_FEWEST_PIXELS, _LEAST_SHARE, _UNLIKE_WITHOUT_SHARE = 20, 0.1, 0.2
# A mask that comes so near to the border of its image is cut off.
_BORDER_PX = 2


Parts: TypeAlias = list[list[list[int]]]
"""Of each track its parts, each the rows of the views of one car in the order of time."""


@dataclass(frozen=True)
class SaidOfShape:
    """What each of B views says of its code about where it ended, its pose following: `c^T A c / 2 - b^T c`.

    A view that is not trusted says nothing (A and b are 0): that it ended elsewhere is no sign of another car. Where a
    track is cut beside it, it goes with the later views.
    """

    A: Tensor  # (B, K, K)
    b: Tensor  # (B, K, 1)
    anything: Tensor  # (B,) bool: there is such a quadratic, so that it can share a shape, trusted or not

    @classmethod
    def at(cls, minimum: Minimum[CarState]) -> SaidOfShape:
        """Of B cars where each ended by itself."""
        hessian = minimum.after.hessian.sum(dim=1)
        nothing = torch.zeros_like(hessian[:, 0])
        _, solvable = damped_step(hessian, nothing, nothing[:, 0])
        # All slopes of a minimum add up to nothing.
        A, _, has_any = said_of_shared(hessian, nothing, *own_and_shared(minimum.end))
        trusted = torch.where(is_refined(minimum.status)[:, None, None], A, 0.0)
        return cls(trusted, trusted @ minimum.end.code.to(A)[:, :, None], solvable & has_any)

    def saved(self, views: list[int]) -> Tensor:
        """Twice the cost (V - 1,) that is saved if before and after each cut in time have a shape of their own."""
        index = torch.tensor(views, device=self.A.device)
        A, b = (x.index_select(0, index).cumsum(dim=0) for x in (self.A, self.b))

        def twice_least(A: Tensor, b: Tensor) -> Tensor:
            # Views that say nothing have the least 0, wherever it is.
            solution: Tensor = torch.linalg.solve_ex(A, b)[0].nan_to_num(0.0, 0.0, 0.0)
            return -(b * solution).sum(dim=(1, 2))

        together = twice_least(A[-1:], b[-1:])
        return together - twice_least(A[:-1], b[:-1]) - twice_least(A[-1] - A[:-1], b[-1] - b[:-1])


@torch.no_grad()
def unlikeness(term: NextView, is_cut: Tensor, seen_end: Sight, next_view: Tensor) -> Tensor:
    """How much less like the next (B,) each of B views of tracks is than a turning car explains; 0 if nobody knows.

    The image ends within the mask of views that are cut, `is_cut` (B,).
    """
    alike, count = term.likeness(seen_end)
    towards = torch.nn.functional.normalize(seen_end.state.T_obj_cam[:, :3, 3], dim=1)
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
    """Whether (B,) the left image ends within the mask of each car, at the left or right or below."""
    left, cars = stereo.left, stereo.cars
    height, width = left.pyramid[0].sizes[cars.frame_index].unbind(1)
    u0, _, u1, v1 = left.mask_left.extents[cars.detection_row].unbind(1)
    return (u1 > u0) & ((u0 < _BORDER_PX) | (u1 > width - _BORDER_PX) | (v1 > height - _BORDER_PX))


def parts_by_shape(cars: CarBatch, says: SaidOfShape, joins: Tensor) -> Parts:
    """The parts of each track of B cars: rows of the views of one car, in the order of times, or of frames.

    Args:
        cars: with their tracks.
        says: what each says of its shape.
        joins: (B,) bool, which may share a shape.
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
    """The parts, each cut in time where there is most evidence of two cars, if that is too much.

    Once, for where two cars were made one the looks of its other views suffer too. `unlike` (B,) is `unlikeness`.
    """
    return [[piece for part in of_track for piece in _of_one_car(part, says, unlike)] for of_track in parts]


def _of_one_car(views: list[int], says: SaidOfShape, unlike: Tensor) -> list[list[int]]:
    if len(views) < 2:
        return [views]
    before_cuts = torch.tensor(views[:-1], device=unlike.device)
    evidence: list[float] = (says.saved(views) + _UNLIKE * unlike.index_select(0, before_cuts)).tolist()
    cut = max(range(len(evidence)), key=evidence.__getitem__)
    return [views[: cut + 1], views[cut + 1 :]] if evidence[cut] > _MOST_EVIDENCE else [views]
