"""Cars refined by themselves, then the views of each track together: one shape, and steps in common.

So what each says of the shape is known before they are made to agree. A view that is not trusted in its track keeps
what it was alone. One that fails in it, or was not trusted alone either, leaves, and the others are brought together
again; so they are, in parts, where it shows that a track is not of one car.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from directshape_torch.refinement.one_car import SaidOfShape, cut_once, own_and_shared, parts_by_shape, unlikeness
from directshape_torch.refinement.outcome import at_states, going_on, judged, of_views_of_tracks, outcome_of
from directshape_torch.refinement.problem import CarProblem
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.solver.differentiate import implicit_state, unrolled_state
from directshape_torch.solver.gauss_newton import Minimum, minimise
from directshape_torch.solver.problem import put_rows, take_rows, where_rows
from directshape_torch.solver.sharing import Groups
from directshape_torch.status import Status, is_refined
from directshape_torch.terms.cars import CarBatch, CarState, retract
from directshape_torch.terms.motion import NUM_PATH, hold_of_path, motion_terms, timed, with_path
from directshape_torch.terms.next_view import NextView, NextViews
from directshape_torch.terms.photometric import Photometric
from directshape_torch.terms.term import Term

# Of a track, times those of the last stage.
_MORE_ITERATIONS = 2
# Errors of two views of one rendered car, each refined by itself, correlate by 0.5 in depth, 0.3 across and 0.8 in
# length: this share of a view's covariance is common to all of its track, who do not reduce it.
_IN_COMMON = 0.5


def refined(problem: CarProblem, cars: CarBatch, initial: CarState, came: RefinementResult) -> RefinementResult:
    """The result of B cars, with the graph of the backward mode.

    Args:
        problem: of these cars, each by itself.
        cars: their tracks.
        initial: input states.
        came: what is known of the cars beforehand.
    """
    unroll = torch.is_grad_enabled() and problem.config.backward.mode == "unroll"
    minimum, found = _judged(problem, cars, initial, initial, came)
    if cars.track_id is None:
        return at_states(found, _attached(problem, cars, initial, minimum))
    says = SaidOfShape.at(problem, minimum)
    doubtful = minimum.status == Status.not_trusted.code
    joins = (is_refined(minimum.status) | doubtful) & says.anything
    parts = parts_by_shape(cars, says, joins)
    # Until no view leaves and no part is cut.
    while True:
        shared = together(problem, cars, minimum, parts)
        if shared is None:
            return at_states(found, _attached(problem, cars, initial, minimum))
        views, rows = cars.of_cars(shared.keep), shared.keep.nonzero()[:, 0]
        agreed = shared.agreed(take_rows(minimum.end, rows))
        before = shared.linked(take_rows(initial, rows))
        in_track, of_track = _judged(shared.problem, views, before, agreed, came.rows(rows))
        left = (in_track.status == Status.singular.code) | (in_track.status == Status.non_finite.code)
        # Nor is a view trusted on the word of a track in which nobody else is.
        unsure = ~is_refined(in_track.status) | (shared.part_of(in_track.status) < 0)
        left = left | (doubtful[rows] & unsure)
        if bool(left.any()):
            # What the others know once they know without it: from the beginning. Before any cut by looks, which differ
            # from what they should be where a view is placed wrongly.
            joins = joins.index_fill(0, rows[left], False)
            parts = parts_by_shape(cars, says, joins)
            continue
        unlike = torch.zeros_like(minimum.after.cost).index_copy(0, rows, shared.unlike_next(in_track))
        tried, parts = parts, cut_once(parts, says, unlike)
        if parts == tried:
            break
    chosen = is_refined(in_track.status).nonzero()[:, 0]
    stays = is_refined(minimum.status).index_fill(0, rows[chosen], False)
    # Where views began together has a part in gradients by repeated steps, in no others.
    alone = _attached(problem, cars, initial, _at_ends(minimum, stays | shared.keep if unroll else stays))
    # A track's steps depend on all of its views, trusted or not.
    of_all = _at_ends(in_track, torch.ones_like(rows, dtype=torch.bool))
    of_views = _attached(shared.problem, views, shared.agreed(take_rows(alone, rows)), of_all)
    in_common = torch.lerp(of_track.covariance, found.covariance[rows], _IN_COMMON)
    of_track = replace(of_track, track_part=shared.part_of(in_track.status), covariance=in_common)
    of_track = of_views_of_tracks(of_track, in_track.end, views)
    found = going_on(found, rows[chosen], of_track.rows(chosen))
    # Path and neighbours have done their work.
    of_views = of_views._replace(path=of_views.path[:, :0], T_obj_next=of_views.T_obj_next[:, :0])
    return at_states(found, put_rows(alone, rows[chosen], take_rows(of_views, chosen)))


def _judged(
    problem: CarProblem, cars: CarBatch, initial: CarState, start: CarState, came: RefinementResult
) -> tuple[Minimum[CarState], RefinementResult]:
    """Where the iterations end, and what is said of it, with the statuses that evidence and trust give."""
    record = torch.is_grad_enabled() and problem.config.backward.mode == "unroll"
    with torch.no_grad():
        minimum = minimise(problem, initial, problem.config.solver, start, record)
        found = outcome_of(problem, minimum, cars, came)
        return judged(minimum, initial, found, problem.config.acceptance)


def _at_ends(minimum: Minimum[CarState], which: Tensor) -> Minimum[CarState]:
    """For `_attached`: these cars (B,) where their iterations ended, trusted or not; the others as if not refined."""
    status = torch.where(which, Status.converged.code, Status.rejected_worse.code)
    return replace(minimum, state=where_rows(which, minimum.end, minimum.state), status=status)


def _attached(problem: CarProblem, cars: CarBatch, start: CarState, minimum: Minimum[CarState]) -> CarState:
    """The states of a minimum, with the graph of the backward mode for every car that was refined."""
    refined = is_refined(minimum.status)
    rows = refined.nonzero()[:, 0]
    if not torch.is_grad_enabled() or not len(rows):
        return minimum.state
    part, backward, names = problem.of_problems(refined), problem.config.backward, cars.detection_row[rows]
    if backward.mode == "unroll":
        first = take_rows(start, rows)
        state = unrolled_state(part, first, minimum, rows, backward.unroll_iterations, names)
    else:
        exact, limit = backward.mode == "implicit", backward.max_remaining_step
        state = implicit_state(part, minimum, rows, exact=exact, max_remaining_step=limit, names=names)
    return put_rows(minimum.state, rows, state)


@dataclass(frozen=True)
class Together:
    """Views that share a shape with others."""

    keep: Tensor  # (B,) bool, which of the cars of the call they are
    problem: CarProblem  # of these R views, its last stage alone
    agreement: Groups  # whose codes are one
    cars: CarBatch  # the views, with times and cameras of their track
    hessian: Tensor  # (R, D, D) of what each adds to the cost of its track, where it ended by itself
    part: Tensor  # (R,) of its track, 0 unless it was split
    next_view: Tensor  # (R,) number of the next view of its part in time, of the last one its own

    def agreed(self, alone: CarState) -> CarState:
        """States (R) with the one shape on which the views agree best, and poses as they go with it.

        Each view's cost is a quadratic about where it ended by itself; the sum of a track's has its least at one code.
        """
        number = torch.arange(6, 6 + alone.code.shape[1], device=alone.code.device)
        step = torch.zeros_like(self.hessian[:, 0]).index_copy(1, number, alone.code.to(self.hessian.dtype))
        slope = -(self.hessian @ step[:, :, None])[:, :, 0]
        undamped, everybody = torch.zeros_like(slope[:, 0]), torch.ones_like(slope[:, 0], dtype=torch.bool)
        to_agreement, _ = self.agreement.damped_step(self.hessian, slope, undamped, everybody)
        max_code = self.problem.config.solver.max_code
        code = to_agreement[:, number].to(alone.code).clamp(-max_code, max_code)
        return self.linked(retract(alone, to_agreement - step)._replace(code=code))

    def linked(self, state: CarState) -> CarState:
        """States (R) with the paths that fit their views best, and poses of next views, where these are unknowns."""
        if self.problem.num_next:
            state = state._replace(T_obj_next=state.T_obj_cam[self.next_view][:, None])
        return with_path(self.problem.config.tracks, self.agreement, self.cars, state)

    def unlike_next(self, minimum: Minimum[CarState]) -> Tensor:
        """How unlike the next view of their part views (R,) are."""
        term = next((term for term in minimum.stage.terms if isinstance(term, NextView)), None)
        if term is None:
            return torch.zeros_like(minimum.after.cost)
        return unlikeness(term, minimum.seen_end, self.next_view)

    def part_of(self, status: Tensor) -> Tensor:
        """The part of its track (R,), -1 for a view that ends with a shape of its own: no other was refined."""
        is_in = is_refined(status)
        return torch.where(self.agreement.total(is_in.to(torch.float64), is_in) > 1, self.part, -1)


def together(
    problem: CarProblem, cars: CarBatch, minimum: Minimum[CarState], parts: list[list[list[int]]]
) -> Together | None:
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
    numbers = sorted(views_of_parts)
    group, place, after, of_part = zip(*(views_of_parts[row] for row in numbers), strict=True)
    index = torch.tensor(numbers, device=minimum.status.device)
    keep = torch.zeros_like(minimum.status, dtype=torch.bool).index_fill(0, index, True)
    own, shared = own_and_shared(problem, keep.device)
    sharing = Groups.of(group, own, shared, place=place)
    part_number = torch.tensor(of_part, device=keep.device)
    next_view = torch.tensor([numbers.index(row) for row in after], device=keep.device)
    timed_views = timed(sharing, cars.of_cars(keep))
    trusted = is_refined(minimum.status).index_select(0, index)
    alone = take_rows(minimum.end, index)
    of_track = in_tracks(problem.of_problems(keep), sharing, timed_views, alone, trusted, next_view)
    hessian = minimum.after.hessian.sum(dim=1)[index]
    return Together(keep, of_track, sharing, timed_views, hessian, part_number, next_view)


def in_tracks(
    problem: CarProblem, sharing: Groups, views: CarBatch, alone: CarState, trusted: Tensor, next_view: Tensor
) -> CarProblem:
    """The last stage of a problem of R views: one shape in each group, a path where times are known, each view seen in
    the next.

    `alone` is where they ended by themselves, `trusted` (R,) who is trusted there.
    """
    everybody = sharing.everybody
    one = everybody.to(torch.float64)
    factors = one[:, None].expand(-1, len(problem.term_names)) if problem.factors is None else problem.factors
    last = problem.config.stages[-1]
    # Views that look at each other take more steps to settle.
    last = replace(last, max_iterations=_MORE_ITERATIONS * last.max_iterations)
    config = replace(problem.config, stages=(last,))
    terms: list[Term] = [*motion_terms(config.tracks, views)]
    # A track has one acceleration, whoever its views are.
    columns = (
        [hold_of_path(config.tracks, sharing, views, alone, trusted), 1 / sharing.total(one, everybody)]
        if terms
        else []
    )
    num_path = NUM_PATH if terms else 0
    stereo = next((term for term in problem.terms if isinstance(term, Photometric)), None)
    num_next = int(stereo is not None and config.tracks.next_view_weight > 0)
    if stereo is not None and num_next:
        terms.append(NextView(config.tracks.next_view_weight, stereo, NextViews.of(views, next_view)))
        columns.append(one)
    own = len(problem.terms) - problem.num_extra
    before = sum(len(term.names) for term in problem.terms[:own])
    first = len(sharing.own) + len(sharing.shared)
    number = torch.arange(first, first + num_path + 6 * num_next, device=sharing.own.device)
    shared = torch.cat([sharing.shared, number[:num_path]])
    return replace(
        problem,
        config=config,
        terms=(*problem.terms[:own], *terms, *problem.terms[own:]),
        factors=torch.cat([factors[:, :before], *(x[:, None] for x in columns), factors[:, before:]], dim=1),
        sharing=Groups.of(sharing.group, sharing.own, shared, number[num_path:], sharing.place),
        num_path=num_path,
        num_next=num_next,
    )
