"""This module refines the views of a track together, with one shape, after each view was refined alone.

What each view says of the shape is thus known before the views agree. A view that is not trusted in its track keeps its
result from the refinement alone. A view that fails in the track, or is trusted neither there nor alone, leaves the
track, and the other views are refined together again. Where a track proves to be of more than one car, its parts are
refined together again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

import torch
from torch import Tensor

from directshape_torch.config import StageConfig
from directshape_torch.errors import InputError
from directshape_torch.numerics.tables import Chosen, take_rows
from directshape_torch.refinement.make_result import at_states, going_on, of_views_of_tracks
from directshape_torch.refinement.problem import CarProblem, stage_of
from directshape_torch.refinement.refined import Refined
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.solver.problem import put_rows
from directshape_torch.solver.sharing import Groups
from directshape_torch.state.cars import CarBatch, CarState
from directshape_torch.state.unknowns import CODE
from directshape_torch.status import Status, is_refined
from directshape_torch.terms.term import Evidence
from directshape_torch.tracks.next_view import NEXT_VIEW_NAME, NextView, NextViewEvidence, NextViews
from directshape_torch.tracks.path import MOTION_NAMES, hold_of_path, motion_terms, timed, with_path
from directshape_torch.tracks.same_car import Parts, SaidOfShape, cut_once, is_cut_off, parts_by_shape, unlikeness
from directshape_torch.tracks.state import NEXT_POSE, PATH, TrackState, own_and_shared

# A track has this many times the iterations of the last stage.
_MORE_ITERATIONS = 2
# Errors of two views of one rendered car, each refined alone, correlate by 0.5 in depth, 0.3 across and 0.8 in length.
# This share of a view's covariance is therefore common to all views of its track, and more views leave it unreduced.
_IN_COMMON = 0.5


def brought_together(
    problem: CarProblem, cars: CarBatch, initial: CarState, unrefined: RefinementResult
) -> RefinementResult:
    """Return the result of B cars, some of which are views of tracks, with the graph of the backward mode.

    Args:
        problem: the problem of these cars, each refined alone.
        cars: the cars, with their tracks.
        initial: input states.
        unrefined: what is known of the cars beforehand.
    """
    for name in (name for name in (*MOTION_NAMES, NEXT_VIEW_NAME) if name in problem.term_names):
        cure = "give the term another name"
        raise InputError(f"extra term {name!r}: names", "names that no column of a track has", repr(name), cure)
    alone = Refined.of(problem, cars, initial, initial, unrefined)
    says = SaidOfShape.at(alone.minimum)
    doubtful = alone.minimum.status == Status.not_trusted.code
    joins = (is_refined(alone.minimum.status) | doubtful) & says.anything
    parts = parts_by_shape(alone.cars, says, joins)
    while (views := Views.of(alone, parts)) is not None:
        in_track = views.refined(take_rows(initial, views.chosen.index), unrefined.rows(views.chosen.index))
        leaves = views.leaving(in_track, doubtful[views.chosen.index])
        if bool(leaves.any()):
            # The other views start again without the views that leave. This comes before any cut by likeness, because a
            # view in a wrong place falsifies the likeness.
            joins = joins.index_fill(0, views.chosen.index[leaves], False)
            parts = parts_by_shape(alone.cars, says, joins)
            continue
        finer = cut_once(parts, says, views.unlike_next(in_track))
        if finer == parts:
            return _joined(alone, views, in_track, initial)
        parts = finer
    return alone.result(initial)


def _joined(
    alone: Refined[CarState], views: Views, in_track: Refined[TrackState], initial: CarState
) -> RefinementResult:
    """The result of all cars, after the last view has left its track and the last track has been cut."""
    status, rows = in_track.minimum.status, views.chosen.index
    chosen = is_refined(status).nonzero()[:, 0]
    ends = is_refined(alone.minimum.status).index_fill(0, rows[chosen], False)
    if alone.problem.config.backward.mode == "unroll" and torch.is_grad_enabled():
        # Only gradients by repeated steps depend on the states from which views began together.
        ends = ends | views.chosen.keep
    states = alone.states(initial, ends)
    # The steps of a track depend on all of its views, trusted or not.
    everyone = torch.ones_like(rows, dtype=torch.bool)
    of_views = in_track.states(views.agreed(take_rows(states, rows)), everyone)
    in_common = torch.lerp(in_track.found.covariance, alone.found.covariance[rows], _IN_COMMON)
    of_track = replace(in_track.found, track_part=views.part_of(status), covariance=in_common)
    of_track = of_views_of_tracks(of_track, in_track.minimum.end, in_track.cars)
    found = going_on(alone.found, rows[chosen], of_track.rows(chosen))
    return at_states(found, put_rows(states, rows[chosen], take_rows(of_views.alone, chosen)))


@dataclass(frozen=True)
class Views:
    """`Views` are R views that share a shape with other views."""

    chosen: Chosen  # cars of the call that are these views
    problem: CarProblem  # problem of these views, with the last stage alone
    agreement: Groups  # groups of views that share a code
    cars: CarBatch  # the views
    timed: CarBatch  # the views, with times and cameras relative to their track
    alone: CarState  # states where the views ended when refined alone
    hessian: Tensor  # (R, D, D) Hessian of the cost of each view at `alone`
    part: Tensor  # (R,) number of the part of its track, 0 unless the track was split
    next_view: Tensor  # (R,) number of the next view of its part in time; the last view has its own number

    @classmethod
    def of(cls, alone: Refined[CarState], parts: Parts) -> Views | None:
        """The views of each part of each track, with rows of B cars; None where no cars share a shape."""
        # A view has a group, a place in it, the view in the next place, and the number of the part of its track.
        views_of_parts: dict[int, tuple[int, int, int, int]] = {}
        for parts_of_track in parts:
            for number, part in enumerate(parts_of_track):
                if len(part) > 1:
                    followers = [*part[1:], part[-1]]
                    views_of_parts |= {row: (part[0], k, followers[k], number) for k, row in enumerate(part)}
        if not views_of_parts:
            return None
        numbers, minimum = sorted(views_of_parts), alone.minimum
        group, place, after, of_part = zip(*(views_of_parts[row] for row in numbers), strict=True)
        rows = torch.tensor(numbers, device=minimum.status.device)
        keep = torch.zeros_like(minimum.status, dtype=torch.bool).index_fill(0, rows, True)
        ends = take_rows(minimum.end, rows)
        sharing = Groups.from_numbers(group, *own_and_shared(ends), place=place)
        chosen = Chosen(keep, numbers)
        cars = alone.cars.of(chosen)
        views = timed(sharing, cars)
        trusted = is_refined(minimum.status).index_select(0, rows)
        next_view = torch.tensor([numbers.index(row) for row in after], device=keep.device)
        problem = in_tracks(alone.problem.of(chosen), sharing, views, ends, trusted, next_view)
        part_number = torch.tensor(of_part, device=keep.device)
        hessian = minimum.after.hessian.sum(dim=1)[rows]
        return cls(chosen, problem, sharing, cars, views, ends, hessian, part_number, next_view)

    def refined(self, initial: CarState, unrefined: RefinementResult) -> Refined[TrackState]:
        """The views refined together, starting from the shape on which they agree."""
        return Refined.of(self.problem, self.cars, self.linked(initial), self.agreed(self.alone), unrefined)

    def agreed(self, alone: CarState) -> TrackState:
        """Return states (R) with the one shape on which the views agree best, and with the poses that belong to it.

        The cost of each view is a quadratic about the state where it ended alone; the sum of the quadratics of a track
        has its minimum at one code.
        """
        unknowns = alone.unknowns
        of_code, max_code = unknowns.span(CODE), self.problem.config.solver.max_code
        step = unknowns.placed(alone.code.to(self.hessian.dtype), (CODE,))
        slope = -(self.hessian @ step[:, :, None])[:, :, 0]
        undamped = torch.zeros_like(slope[:, 0])
        to_agreement, _ = self.agreement.damped_step(self.hessian, slope, undamped, self.agreement.all_members)
        code = to_agreement[:, of_code].to(alone.code).clamp(-max_code, max_code)
        return self.linked(unknowns.retract(alone, to_agreement - step)._replace(code=code))

    def linked(self, alone: CarState) -> TrackState:
        """States (R) with the paths that fit best and the poses of next views, where these are unknowns."""
        return _linked(self.problem, self.agreement, self.timed, alone, self.next_view)

    def leaving(self, in_track: Refined[TrackState], doubtful: Tensor) -> Tensor:
        """Mask (R,) of views that leave their track: they fail in it, or are trusted neither alone nor in it.

        A view that was not trusted alone also leaves a track in which no other view is trusted.
        """
        status = in_track.minimum.status
        fails = (status == Status.singular.code) | (status == Status.non_finite.code)
        return fails | (doubtful & (~is_refined(status) | (self.part_of(status) < 0)))

    def unlike_next(self, in_track: Refined[TrackState]) -> Tensor:
        """Unlikeness (B,) of each car and the next view of its part; 0 for cars outside these views."""
        minimum = in_track.minimum
        nothing = torch.zeros(len(self.chosen.keep), dtype=minimum.after.cost.dtype, device=self.chosen.keep.device)
        term = cast("NextView | None", stage_of(minimum).term(NEXT_VIEW_NAME))
        stereo = self.problem.photometric
        if term is None or stereo is None:
            return nothing
        unlike = unlikeness(term, is_cut_off(stereo), minimum.prepared_end, self.next_view)
        return nothing.index_copy(0, self.chosen.index, unlike)

    def part_of(self, status: Tensor) -> Tensor:
        """Part (R,) of the track of each view; -1 where no other view of the part was refined to share its shape."""
        is_in = is_refined(status)
        return torch.where(self.agreement.total(is_in.to(torch.float64), is_in) > 1, self.part, -1)


def _linked(problem: CarProblem, sharing: Groups, views: CarBatch, alone: CarState, next_view: Tensor) -> TrackState:
    state = TrackState.of(alone)
    if _has_next_view(problem):
        state = state._replace(T_obj_next=state.T_obj_cam[next_view][:, None])
    return with_path(problem.config.tracks, sharing, views, state)


def _has_next_view(problem: CarProblem) -> bool:
    return problem.config.tracks.next_view_weight > 0 and problem.photometric is not None


def stage_of_tracks(stages: Sequence[StageConfig]) -> StageConfig:
    """The last stage, with all unknowns that some stage moves; views that depend on each other need more iterations."""
    last = stages[-1]
    unknowns = last.unknowns if all(stage.unknowns == last.unknowns for stage in stages) else "both"
    return replace(last, max_iterations=_MORE_ITERATIONS * last.max_iterations, unknowns=unknowns)


def in_tracks(
    problem: CarProblem, sharing: Groups, views: CarBatch, alone: CarState, trusted: Tensor, next_view: Tensor
) -> CarProblem:
    """Return the last stage of a problem of R views that share a shape in each group.

    The views follow a path where times are known, and each view is seen in the next one. The states `alone` are where
    the views ended when refined alone; `trusted` (R,) marks the views that are trusted there.
    """
    one = torch.ones_like(sharing.of_problem, dtype=torch.float64)
    factors = one[:, None].expand(-1, len(problem.term_names)) if problem.factors is None else problem.factors
    config = replace(problem.config, stages=(stage_of_tracks(problem.config.stages),))
    added: list[Evidence] = [*motion_terms(config.tracks, views)]
    columns: list[Tensor] = []
    if added:
        # A track has one acceleration, so its prior is divided among all views.
        hold = hold_of_path(config.tracks, sharing, views, alone, trusted)
        columns = [hold, 1 / sharing.total(one, sharing.all_members)]
    stereo = problem.photometric
    if stereo is not None and _has_next_view(problem):
        added.append(NextViewEvidence(config.tracks.next_view_weight, stereo, NextViews.of(views, next_view)))
        columns.append(one)
    before = sum(len(each.names) for each in problem.evidence)
    unknowns, device = _linked(problem, sharing, views, alone, next_view).unknowns, alone.code.device
    shared = torch.cat([sharing.shared, unknowns.columns((PATH,), device)])
    of_next = unknowns.columns((NEXT_POSE,), device)
    return replace(
        problem,
        config=config,
        evidence=(*problem.evidence, *added),
        factors=torch.cat([factors[:, :before], *(x[:, None] for x in columns), factors[:, before:]], dim=1),
        sharing=Groups.from_numbers(sharing.group, sharing.own, shared, of_next, sharing.place),
    )
