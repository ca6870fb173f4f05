"""Views of a track, each refined by itself, brought together: one shape, and steps in common.

So what each says of the shape is known before they are made to agree. A view that is not trusted in its track keeps
what it was alone. One that fails in it, or was not trusted alone either, leaves, and the others are brought together
again; so they are, in parts, where it shows that a track is not of one car.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.refinement.outcome import at_states, going_on, of_views_of_tracks
from directshape_torch.refinement.problem import CarProblem
from directshape_torch.refinement.refined import Refined
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.solver.problem import put_rows, take_rows
from directshape_torch.solver.sharing import Groups
from directshape_torch.state.cars import CarBatch, CarState
from directshape_torch.state.unknowns import CODE
from directshape_torch.status import Status, is_refined
from directshape_torch.terms.photometric import PhotometricEvidence
from directshape_torch.terms.term import Evidence
from directshape_torch.tracks.next_view import NEXT_VIEW_NAME, NextView, NextViewEvidence, NextViews
from directshape_torch.tracks.path import MOTION_NAMES, hold_of_path, motion_terms, timed, with_path
from directshape_torch.tracks.same_car import Parts, SaidOfShape, cut_once, is_cut_off, parts_by_shape, unlikeness
from directshape_torch.tracks.state import NEXT_POSE, PATH, TrackState, own_and_shared

# Of a track, times those of the last stage.
_MORE_ITERATIONS = 2
# Errors of two views of one rendered car, each refined by itself, correlate by 0.5 in depth, 0.3 across and 0.8 in
# length: this share of a view's covariance is common to all of its track, who do not reduce it.
_IN_COMMON = 0.5


def brought_together(
    problem: CarProblem, cars: CarBatch, initial: CarState, came: RefinementResult
) -> RefinementResult:
    """The result of B cars, some of which are views of tracks, with the graph of the backward mode.

    Args:
        problem: of these cars, each by itself.
        cars: the cars, with their tracks.
        initial: input states.
        came: what is known of the cars beforehand.
    """
    for name in (name for name in (*MOTION_NAMES, NEXT_VIEW_NAME) if name in problem.term_names):
        cure = "give the term another name"
        raise InputError(f"extra term {name!r}: names", "names that no column of a track has", repr(name), cure)
    alone = Refined.of(problem, cars, initial, initial, came)
    says = SaidOfShape.at(alone.minimum)
    doubtful = alone.minimum.status == Status.not_trusted.code
    joins = (is_refined(alone.minimum.status) | doubtful) & says.anything
    parts = parts_by_shape(alone.cars, says, joins)
    while (views := Views.of(alone, parts)) is not None:
        in_track = views.refined(take_rows(initial, views.rows), came.rows(views.rows))
        leaves = views.leaving(in_track, doubtful[views.rows])
        if bool(leaves.any()):
            # What the others know once they know without it: from the beginning. Before any cut by looks, which differ
            # from what they should be where a view is placed wrongly.
            joins = joins.index_fill(0, views.rows[leaves], False)
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
    """What is said of all cars, once no view leaves its track and no track is cut."""
    status, rows = in_track.minimum.status, views.rows
    chosen = is_refined(status).nonzero()[:, 0]
    ends = is_refined(alone.minimum.status).index_fill(0, rows[chosen], False)
    if alone.problem.config.backward.mode == "unroll" and torch.is_grad_enabled():
        # Where views began together has a part in gradients by repeated steps, in no others.
        ends = ends | views.keep
    states = alone.states(initial, ends)
    # A track's steps depend on all of its views, trusted or not.
    everybody = torch.ones_like(rows, dtype=torch.bool)
    of_views = in_track.states(views.agreed(take_rows(states, rows)), everybody)
    in_common = torch.lerp(in_track.found.covariance, alone.found.covariance[rows], _IN_COMMON)
    of_track = replace(in_track.found, track_part=views.part_of(status), covariance=in_common)
    of_track = of_views_of_tracks(of_track, in_track.minimum.end, in_track.cars)
    found = going_on(alone.found, rows[chosen], of_track.rows(chosen))
    return at_states(found, put_rows(states, rows[chosen], take_rows(of_views.alone, chosen)))


@dataclass(frozen=True)
class Views:
    """R views that share a shape with others."""

    keep: Tensor  # (B,) bool, which of the cars of the call they are
    rows: Tensor  # (R,) their numbers
    problem: CarProblem  # of these views, its last stage alone
    agreement: Groups  # whose codes are one
    cars: CarBatch  # of all B cars
    timed: CarBatch  # the views, with times and cameras of their track
    alone: CarState  # where they ended by themselves
    hessian: Tensor  # (R, D, D) of what each adds to the cost of its track there
    part: Tensor  # (R,) of its track, 0 unless it was split
    next_view: Tensor  # (R,) number of the next view of its part in time, of the last one its own

    @classmethod
    def of(cls, alone: Refined[CarState], parts: Parts) -> Views | None:
        """The views (rows of B cars) of each part of each track; None where nobody shares a shape."""
        # Of each view its group, its place there, the view in the next place, and the number of the part of its track.
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
        sharing = Groups.of(group, *own_and_shared(ends), place=place)
        views = timed(sharing, alone.cars.of_cars(keep))
        trusted = is_refined(minimum.status).index_select(0, rows)
        next_view = torch.tensor([numbers.index(row) for row in after], device=keep.device)
        problem = in_tracks(alone.problem.of_problems(keep), sharing, views, ends, trusted, next_view)
        part_number = torch.tensor(of_part, device=keep.device)
        hessian = minimum.after.hessian.sum(dim=1)[rows]
        return cls(keep, rows, problem, sharing, alone.cars, views, ends, hessian, part_number, next_view)

    def refined(self, initial: CarState, came: RefinementResult) -> Refined[TrackState]:
        """The views refined together, from the shape on which they agree."""
        cars = self.cars.of_cars(self.keep)
        return Refined.of(self.problem, cars, self.linked(initial), self.agreed(self.alone), came)

    def agreed(self, alone: CarState) -> TrackState:
        """States (R) with the one shape on which the views agree best, and poses as they go with it.

        Each view's cost is a quadratic about where it ended by itself; the sum of a track's has its least at one code.
        """
        unknowns = alone.unknowns
        of_code, max_code = unknowns.span(CODE), self.problem.config.solver.max_code
        step = unknowns.placed(alone.code.to(self.hessian.dtype), (CODE,))
        slope = -(self.hessian @ step[:, :, None])[:, :, 0]
        undamped, everybody = torch.zeros_like(slope[:, 0]), torch.ones_like(slope[:, 0], dtype=torch.bool)
        to_agreement, _ = self.agreement.damped_step(self.hessian, slope, undamped, everybody)
        code = to_agreement[:, of_code].to(alone.code).clamp(-max_code, max_code)
        return self.linked(unknowns.retract(alone, to_agreement - step)._replace(code=code))

    def linked(self, alone: CarState) -> TrackState:
        """States (R) with the paths that fit their views best, and poses of next views, where these are unknowns."""
        return _linked(self.problem, self.agreement, self.timed, alone, self.next_view)

    def leaving(self, in_track: Refined[TrackState], doubtful: Tensor) -> Tensor:
        """Views (R,) that leave their track: they fail in it, or are trusted neither alone nor by it.

        Nor is a view trusted on the word of a track in which nobody else is.
        """
        status = in_track.minimum.status
        fails = (status == Status.singular.code) | (status == Status.non_finite.code)
        return fails | (doubtful & (~is_refined(status) | (self.part_of(status) < 0)))

    def unlike_next(self, in_track: Refined[TrackState]) -> Tensor:
        """How unlike the next view of their part cars (B,) are; 0 for those that are no such views."""
        minimum = in_track.minimum
        nothing = torch.zeros(len(self.keep), dtype=minimum.after.cost.dtype, device=self.keep.device)
        term = next((term for term in minimum.stage.terms if isinstance(term, NextView)), None)
        stereo = _photometric(self.problem)
        if term is None or stereo is None:
            return nothing
        unlike = unlikeness(term, is_cut_off(stereo), minimum.seen_end, self.next_view)
        return nothing.index_copy(0, self.rows, unlike)

    def part_of(self, status: Tensor) -> Tensor:
        """The part of its track (R,), -1 for a view that ends with a shape of its own: no other was refined."""
        is_in = is_refined(status)
        return torch.where(self.agreement.total(is_in.to(torch.float64), is_in) > 1, self.part, -1)


def _linked(problem: CarProblem, sharing: Groups, views: CarBatch, alone: CarState, next_view: Tensor) -> TrackState:
    state = TrackState.of(alone)
    if _looks_at_next(problem):
        state = state._replace(T_obj_next=state.T_obj_cam[next_view][:, None])
    return with_path(problem.config.tracks, sharing, views, state)


def _looks_at_next(problem: CarProblem) -> bool:
    return problem.config.tracks.next_view_weight > 0 and _photometric(problem) is not None


def _photometric(problem: CarProblem) -> PhotometricEvidence | None:
    return next((each for each in problem.evidence if isinstance(each, PhotometricEvidence)), None)


def in_tracks(
    problem: CarProblem, sharing: Groups, views: CarBatch, alone: CarState, trusted: Tensor, next_view: Tensor
) -> CarProblem:
    """The last stage of a problem of R views: one shape in each group, a path where times are known, each view seen in
    the next.

    `alone` is where they ended by themselves, `trusted` (R,) who is trusted there.
    """
    one = torch.ones_like(sharing.of_problem, dtype=torch.float64)
    factors = one[:, None].expand(-1, len(problem.term_names)) if problem.factors is None else problem.factors
    last = problem.config.stages[-1]
    # Views that look at each other take more steps to settle.
    last = replace(last, max_iterations=_MORE_ITERATIONS * last.max_iterations)
    config = replace(problem.config, stages=(last,))
    added: list[Evidence] = [*motion_terms(config.tracks, views)]
    columns: list[Tensor] = []
    if added:
        # A track has one acceleration, whoever its views are.
        hold = hold_of_path(config.tracks, sharing, views, alone, trusted)
        columns = [hold, 1 / sharing.total(one, sharing.everybody)]
    stereo = _photometric(problem)
    if stereo is not None and _looks_at_next(problem):
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
        sharing=Groups.of(sharing.group, sharing.own, shared, of_next, sharing.place),
    )
