"""This module refines cars from several poses each, and keeps the result that explains the masks best.

Every pose of a car is refined on the same problem, so all results of a car have the same pixels, occluders and contour
widths, and no pose hides another one. Their silhouettes and priors at the last stage compare. Their photometric costs
do not: each result has its own pixels, where rays meet its surface, and even over equal pixels the differences show
rather in which local minimum the depth ended (docs/no_boxes.md). The choice among the results has no gradient.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from directshape_torch.geometry import se3
from directshape_torch.numerics.tables import Chosen, take_rows
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
    problem: CarProblem,
    cars: CarBatch,
    initial: CarState,
    other_T_cam_obj: Tensor,  # (B, C, 4, 4), NaN where a car has fewer
    unrefined: RefinementResult,
) -> tuple[RefinementResult, Tensor]:
    """The results of B cars from the best of their poses, and these poses (B, 4, 4).

    The result of the lowest cost is the best one; a result that is refused is worse than any that is not.
    """
    T_cam_obj = torch.cat([cars.detector_T_cam_obj[:, None], other_T_cam_obj], dim=1)
    in_view = torch.stack([stands_in_view(T, cars.ground_normal_cam) for T in T_cam_obj.unbind(dim=1)], dim=1)
    T_cam_obj, in_view = (each[:, in_view.any(dim=0)] for each in (T_cam_obj, in_view))
    tries = [
        _Try.of(problem, cars, initial, T_start, Chosen.where(has_start), unrefined)
        for T_start, has_start in zip(T_cam_obj.unbind(dim=1), in_view.unbind(dim=1), strict=True)
    ]
    cost, forward, refused = (torch.stack(column, dim=1) for column in zip(*map(_Try.of_all, tries), strict=True))
    only_refused = refused.all(dim=1, keepdim=True)
    best = cost.masked_fill(refused & ~only_refused, torch.inf).argmin(dim=1)
    sense = probability_of_sense(cost, forward, best)
    width = max(each.refined.found.cost_history.shape[1] for each in tries)
    result = tries[0].result(best == 0, sense, width)
    for number, each in enumerate(tries[1:], 1):
        rows = each.chosen.index
        is_best = best[rows] == number
        own = each.result(is_best, sense[rows], width).rows(is_best.nonzero()[:, 0])
        result = result.put(rows[is_best], own)
    return result, T_cam_obj.gather(1, best[:, None, None, None].expand(-1, 1, 4, 4))[:, 0]


class _Try(NamedTuple):
    """A `_Try` is the refinement of those of B cars that have a pose of one number."""

    chosen: Chosen  # the R cars that have the pose
    start: CarState  # where their iterations begin
    refined: Refined[CarState]

    @classmethod
    def of(
        cls,
        problem: CarProblem,
        cars: CarBatch,
        initial: CarState,
        T_cam_obj: Tensor,
        chosen: Chosen,
        unrefined: RefinementResult,
    ) -> _Try:
        rows = chosen.index
        # The box that a result is compared and combined with is the one that it began at.
        own = replace(cars, detector_T_cam_obj=T_cam_obj).of(chosen)
        inputs = take_rows(initial, rows)
        start = inputs._replace(T_obj_cam=se3.inverse(T_cam_obj.index_select(0, rows)))
        return cls(chosen, start, Refined.of(problem.of(chosen), own, inputs, start, unrefined.rows(rows)))

    def of_all(self) -> tuple[Tensor, Tensor, Tensor]:
        """Cost (B,), direction of the front in the camera's frame (B, 3) and whether the result is refused (B,).

        The cost is infinite where there is none.
        """
        minimum, names = self.refined.minimum, self.refined.problem.term_names
        left_out = torch.tensor([name in PhotometricEvidence.names for name in names], device=self.chosen.keep.device)
        cost = minimum.after.term_costs.masked_fill(left_out, 0.0).sum(dim=1)
        cost = cost.masked_fill(cost.isnan(), torch.inf)
        of_all = cost.new_full(self.chosen.keep.shape, torch.inf).index_copy(0, self.chosen.index, cost)
        # The first row of R_obj_cam is the object's x axis in the camera's frame.
        x_axis = minimum.end.T_obj_cam[:, 0, :3]
        forward = x_axis.new_zeros(len(of_all), 3).index_copy(0, self.chosen.index, x_axis)
        refused = torch.ones_like(self.chosen.keep).index_copy(0, self.chosen.index, ~is_refined(minimum.status))
        return of_all, forward, refused

    def result(self, is_best: Tensor, sense: Tensor, width: int) -> RefinementResult:
        """The result (R,), with the graph of the backward mode for the cars that end here.

        Args:
            is_best: (R,) bool, the cars that end here.
            sense: (R,) probabilities of the sense of their headings.
            width: number of iterations of the cost history.
        """
        found, status = self.refined.found, self.refined.minimum.status
        history = pad(found.cost_history, (0, width - found.cost_history.shape[1]), value=torch.nan)
        quality = replace(found.quality, probability_heading=sense)
        found = replace(found, cost_history=history, quality=quality)
        return at_states(found, self.refined.states(self.start, is_refined(status) & is_best))


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
