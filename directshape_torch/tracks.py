"""Cars refined by themselves, then the views of each track together: one shape, and steps in common.

So a view that is not trusted by itself never joins a track, and whoever is not trusted in it keeps what it was alone.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from directshape_torch.diagnosis.outcome import Outcome, judged, outcome_of
from directshape_torch.problem import CarProblem
from directshape_torch.solver.backward import attached_state
from directshape_torch.solver.damped_solve import damped_step
from directshape_torch.solver.gauss_newton import Minimum, minimise
from directshape_torch.solver.problem import put_rows, take_rows
from directshape_torch.solver.sharing import Groups
from directshape_torch.status import Status, is_refined
from directshape_torch.terms.cars import CarBatch, CarState, following, retract

# What the family of shapes says is known once, however many views there are; each detection's dimensions are a
# measurement of their own.
_KNOWN_ONCE = "shape"


def refined(problem: CarProblem, cars: CarBatch, initial: CarState, start: CarState) -> Outcome:
    """The outcome of B cars, with the graph of the backward mode.

    Args:
        problem: of these cars, each by itself.
        cars: their tracks.
        initial: input states.
        start: where the iterations begin, made of the input states by `search_start`.
    """
    unroll = torch.is_grad_enabled() and problem.config.backward.mode == "unroll"
    minimum, outcome = _judged(problem, cars, initial, start, unroll)
    origin = following(initial, start) if unroll else start
    shared = together(problem, cars, minimum)
    if shared is None:
        return replace(outcome, state=_attached(problem, cars, origin, minimum))
    views, rows = cars.of_cars(shared.keep), shared.keep.nonzero()[:, 0]
    agreed = shared.agreed(take_rows(minimum.state, rows))
    in_track, of_track = _judged(shared.problem, views, take_rows(initial, rows), agreed, unroll)
    chosen = is_refined(in_track.status).nonzero()[:, 0]
    if not unroll:
        # What they were alone has no part in their gradients.
        status = minimum.status.index_fill(0, rows[chosen], Status.rejected_worse.code)
        minimum = replace(minimum, status=status)
    alone = _attached(problem, cars, origin, minimum)
    of_views = _attached(shared.problem, views, shared.agreed(take_rows(alone, rows)), in_track)
    outcome = outcome.going_on(rows[chosen], of_track.rows(chosen))
    return replace(outcome, state=put_rows(alone, rows[chosen], take_rows(of_views, chosen)))


@torch.no_grad()
def _judged(
    problem: CarProblem, cars: CarBatch, initial: CarState, start: CarState, record: bool
) -> tuple[Minimum[CarState], Outcome]:
    """Where the iterations end, with the statuses that evidence and trust give, and what is said of it."""
    minimum = minimise(problem, initial, problem.config.solver, start, record)
    outcome = judged(minimum, initial, outcome_of(problem, initial, minimum, cars), problem.config.acceptance)
    return replace(minimum, state=outcome.state, status=outcome.status), outcome


def _attached(problem: CarProblem, cars: CarBatch, start: CarState, minimum: Minimum[CarState]) -> CarState:
    return attached_state(problem, start, minimum, problem.config.backward, cars.detection_row)


@dataclass(frozen=True)
class Together:
    """Views that share a shape with others.

    Attributes:
        keep: (B,) bool, which of the cars of the call they are.
        problem: of these R views, its last stage alone.
        hessian: (R, D, D) of each by itself.
    """

    keep: Tensor
    problem: CarProblem
    hessian: Tensor

    def agreed(self, alone: CarState) -> CarState:
        """States (R) with the one shape on which the views agree best, and poses as they go with it.

        Each view's cost is a quadratic about where it ended by itself; the sum of a track's has its least at one code.
        """
        number = torch.arange(6, 6 + alone.code.shape[1], device=alone.code.device)
        step = torch.zeros_like(self.hessian[:, 0]).index_copy(1, number, alone.code.to(self.hessian.dtype))
        slope = -(self.hessian @ step[:, :, None])[:, :, 0]
        undamped, everybody = torch.zeros_like(slope[:, 0]), torch.ones_like(slope[:, 0], dtype=torch.bool)
        to_agreement, _ = self.problem.sharing.damped_step(self.hessian, slope, undamped, everybody)
        max_code = self.problem.config.solver.max_code
        code = to_agreement[:, number].to(alone.code).clamp(-max_code, max_code)
        return retract(alone, to_agreement - step)._replace(code=code)


def together(problem: CarProblem, cars: CarBatch, minimum: Minimum[CarState]) -> Together | None:
    """Which of B cars share a shape, once each has been refined by itself; None where nobody does."""
    if cars.track_id is None:
        return None
    hessian = minimum.after.hessian.sum(dim=1)
    _, solvable = damped_step(hessian, hessian[:, 0], torch.zeros_like(minimum.after.cost))
    usable = is_refined(minimum.status) & solvable
    groups = _tracks(cars, usable)
    if not groups:
        return None
    of_row = {row: number for number, rows in enumerate(groups) for row in rows}
    numbers = sorted(of_row)
    index = torch.tensor(numbers, device=usable.device)
    keep = torch.zeros_like(usable).index_fill(0, index, True)
    part = _sharing_a_shape(problem.of_problems(keep), [of_row[row] for row in numbers])
    return Together(keep, part, hessian[index])


def _tracks(cars: CarBatch, usable: Tensor) -> list[list[int]]:
    """Rows of the usable views of each track that has several, in the order of the frames."""
    assert cars.track_id is not None
    views: dict[int, list[int]] = {}
    order = cars.frame_index.argsort(stable=True).tolist()
    track_id, is_usable = cars.track_id.tolist(), usable.tolist()
    for row in order:
        if track_id[row] >= 0 and is_usable[row]:
            views.setdefault(track_id[row], []).append(row)
    return [rows for rows in views.values() if len(rows) > 1]


def _sharing_a_shape(problem: CarProblem, group: Sequence[int]) -> CarProblem:
    """The last stage of a problem of R views, whose shapes are one where the group (R,) is."""
    number = torch.arange(6 + problem.prior.num_codes + problem.num_offsets, device=problem.masks.filled.device)
    is_shared = (number >= 6) & (number < 6 + problem.prior.num_codes)
    sizes = Counter(group)
    share = torch.tensor([1 / sizes[name] for name in group], dtype=torch.float64, device=number.device)
    once = torch.stack([share if name == _KNOWN_ONCE else share * 0 + 1 for name in problem.term_names], dim=1)
    return replace(
        problem,
        config=replace(problem.config, stages=problem.config.stages[-1:]),
        sharing=Groups.of(group, number[~is_shared], number[is_shared]),
        factors=once if problem.factors is None else once * problem.factors,
    )
