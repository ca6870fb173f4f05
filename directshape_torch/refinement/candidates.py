"""This module refines cars from several poses each, and keeps the result that explains the masks best.

Every pose of a car is refined on the same problem, so all results of a car have the same pixels, occluders and contour
widths, and no pose hides another one. Their silhouettes and priors at the last stage compare. Their photometric costs
do not: each result has its own pixels, where rays meet its surface, and even over equal pixels the differences show
rather in which local minimum the depth ended (docs/no_boxes.md). The choice among the results has no gradient.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from directshape_torch.geometry import se3
from directshape_torch.numerics.tables import Chosen, joined, take_rows
from directshape_torch.observation.packing import Observation
from directshape_torch.observation.refinable import stands_in_view
from directshape_torch.refinement.make_result import at_states
from directshape_torch.refinement.problem import CarProblem
from directshape_torch.refinement.refined import Refined
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.state.cars import CarBatch, CarState
from directshape_torch.status import is_refined
from directshape_torch.terms.photometric import PhotometricEvidence

SENSE_SCALE = 0.053
"""The odds of the cheaper sense of a heading are 1 plus the difference of the costs of both senses over this number.

They grow slowly, because the shapes of some cars mislead strongly. scripts/calibrate_heading.py fits the number.
"""

# Two headings are the two senses of one axis where they are within 60 degrees of opposite.
_OPPOSITE_COSINE = -0.5


def refined_from_candidates(
    make_problem: Callable[[CarBatch, Observation], CarProblem],
    cars: CarBatch,
    seen: Observation,
    initial: CarState,
    other_T_cam_obj: Tensor,  # (B, C, 4, 4), NaN where a car has fewer
    unrefined: RefinementResult,
) -> tuple[RefinementResult, Tensor]:
    """The results of B cars from the best of their poses, and these poses (B, 4, 4).

    The result of the lowest cost is the best one; a result that is refused is worse than any that is not.

    Args:
        make_problem: makes the problem of some cars of what the images show of them.
        cars: the B cars.
        seen: what the images show of the cars.
        initial: input states.
        other_T_cam_obj: poses besides the input's.
        unrefined: what is known of the cars before the minimisation.
    """
    T_cam_obj = torch.cat([cars.detector_T_cam_obj[:, None], other_T_cam_obj], dim=1)
    in_view = torch.stack([stands_in_view(T, cars.ground_normal_cam) for T in T_cam_obj.unbind(dim=1)], dim=1)
    some = [Chosen.where(column) for column in in_view.unbind(dim=1)]
    # All poses of all cars are refined at once, number by number.
    car, place = torch.cat([each.index for each in some]), in_view.T.flatten().nonzero()[:, 0]
    counts, starts = [len(each.numbers) for each in some], T_cam_obj.transpose(0, 1).flatten(0, 1)[place]
    # The box that a result is compared and combined with is the one that it began at.
    own = replace(joined([cars.of(each) for each in some], counts), detector_T_cam_obj=starts)
    problem = make_problem(own, joined([seen.of(each) for each in some], counts))
    inputs = take_rows(initial, car)
    start = inputs._replace(T_obj_cam=se3.inverse(starts))
    tried = Refined.of(problem, own, inputs, start, unrefined.rows(car))
    cost, forward, refused = _of_all(tried, place, in_view.T)
    best = cost.masked_fill(refused & ~refused.all(dim=1, keepdim=True), torch.inf).argmin(dim=1)
    sense = probability_of_sense(cost, forward, best)
    is_best = best[car] == place // len(in_view)
    return _best(tried, start, is_best, car, sense), T_cam_obj[torch.arange(len(best), device=best.device), best]


def _of_all(tried: Refined[CarState], place: Tensor, in_view: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Costs (B, C), directions of the front in the camera's frame (B, C, 3), and whether results are refused (B, C).

    The results stand at some places (R,) of the table `in_view` (C, B); the cost is infinite where there is none.
    """
    minimum, names = tried.minimum, tried.problem.term_names
    left_out = torch.tensor([name in PhotometricEvidence.names for name in names], device=place.device)
    cost = minimum.after.term_costs.masked_fill(left_out, 0.0).sum(dim=1)
    cost = cost.masked_fill(cost.isnan(), torch.inf)
    # The first row of R_obj_cam is the object's x axis in the camera's frame.
    columns = (cost, torch.inf), (minimum.end.T_obj_cam[:, 0, :3], 0.0), (~is_refined(minimum.status), True)
    cost, forward, refused = (
        values.new_full((in_view.numel(), *values.shape[1:]), nothing).index_copy(0, place, values)
        for values, nothing in columns
    )
    shape = in_view.shape
    return cost.view(shape).T, forward.view(*shape, 3).transpose(0, 1), refused.view(shape).T


def _best(tried: Refined[CarState], start: CarState, is_best: Tensor, car: Tensor, sense: Tensor) -> RefinementResult:
    """The result of each car from its best pose, with the graph of the backward mode.

    Args:
        tried: the R results.
        start: where they began.
        is_best: (R,) bool, the best result of each car.
        car: (R,) the car of each result.
        sense: (B,) probabilities of the sense of the headings.
    """
    states = tried.states(start, is_refined(tried.minimum.status) & is_best)
    rows = is_best.nonzero()[:, 0]
    best = at_states(tried.found, states).rows(rows[car[rows].argsort()])
    return replace(best, quality=replace(best.quality, probability_heading=sense))


def probability_of_sense(
    cost: Tensor,  # (B, N) costs of N results, infinite where there is none
    forward_cam: Tensor,  # (B, N, 3) directions of the front
    best: Tensor,  # (B,) number of the result that is kept
) -> Tensor:
    """Probability (B,) that the front is where the best result has it, and not at the opposite end.

    It is 0.5 where the opposite sense costs as much, and NaN where no result has the opposite sense.

    Examples:
        >>> forward = torch.tensor([[[1.0, 0, 0], [-1.0, 0, 0]]])
        >>> probability_of_sense(torch.tensor([[2.0, 2.5]]), forward, torch.tensor([0]))
        tensor([0.9125])
        >>> probability_of_sense(torch.tensor([[2.0, torch.inf]]), forward, torch.tensor([0]))
        tensor([nan])
    """
    at_best = forward_cam.gather(1, best[:, None, None].expand(-1, 1, 3))
    is_opposite = (forward_cam * at_best).sum(dim=-1) < _OPPOSITE_COSINE
    opposite = cost.masked_fill(~is_opposite, torch.inf).amin(dim=1)
    more = opposite - cost.gather(1, best[:, None])[:, 0]
    of_dearer = 1 / (2 + more.abs() / SENSE_SCALE)
    return torch.where(opposite.isfinite(), torch.where(more < 0, of_dearer, 1 - of_dearer), torch.nan)
