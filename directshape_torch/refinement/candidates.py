"""This module refines cars from several poses each, and keeps the result that explains the masks best.

All poses of all cars are refined in one batch, on the same pixels, occluders, contour widths and priors, and no pose
hides another one. Their silhouettes and priors at the last stage compare. Their photometric costs
do not: each result has its own pixels, where rays meet its surface, and even over equal pixels the differences show
rather in which local minimum the depth ended (docs/no_boxes.md). The choice among the results has no gradient.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

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


@dataclass(frozen=True)
class Candidates:
    """`Candidates` are R poses of B cars, number by number, each with all that is known of its car."""

    T_cam_obj: Tensor  # (B, C, 4, 4) all poses
    in_view: Tensor  # (B, C) which of them are tried
    car: Tensor  # (R,) car of each candidate
    # (R,) the cars with the boxes that were given: priors compare with these boxes, wherever a candidate begins
    cars: CarBatch
    seen: Observation  # of these R cars

    @classmethod
    def of(cls, cars: CarBatch, seen: Observation, other_T_cam_obj: Tensor) -> Candidates:
        """The poses of B cars and others (B, C - 1, 4, 4), which are NaN where a car has fewer."""
        T_cam_obj = torch.cat([cars.detector_T_cam_obj[:, None], other_T_cam_obj], dim=1)
        views = [stands_in_view(T, cars.ground_normal_cam) for T in T_cam_obj.unbind(dim=1)]
        some = [Chosen.where(each) for each in views]
        counts = [len(each.numbers) for each in some]
        return cls(
            T_cam_obj,
            torch.stack(views, dim=1),
            torch.cat([each.index for each in some]),
            joined([cars.of(each) for each in some], counts),
            joined([seen.of(each) for each in some], counts),
        )

    @property
    def number(self) -> Tensor:
        """Number (R,) of each candidate among the poses of its car."""
        return self.in_view.T.nonzero()[:, 0]

    def refined(
        self, problem: CarProblem, initial: CarState, unrefined: RefinementResult
    ) -> tuple[RefinementResult, Tensor]:
        """The results of B cars from the best of their poses, and these poses (B, 4, 4).

        The result of the lowest cost is the best one; a result that is refused is worse than any that is not.

        Args:
            problem: of the R candidates.
            initial: input states of the B cars.
            unrefined: what is known of the B cars before the minimisation.
        """
        starts = self.T_cam_obj[self.car, self.number]
        # The box that a result is compared and combined with is the one that it began at.
        own = replace(self.cars, detector_T_cam_obj=starts)
        inputs = take_rows(initial, self.car)
        start = inputs._replace(T_obj_cam=se3.inverse(starts))
        tried = Refined.of(problem, own, inputs, start, unrefined.rows(self.car))
        cost, forward, refused = self._costs(tried)
        best = cost.masked_fill(refused & ~refused.all(dim=1, keepdim=True), torch.inf).argmin(dim=1)
        is_best = best[self.car] == self.number
        states = tried.states(start, is_refined(tried.minimum.status) & is_best)
        rows = is_best.nonzero()[:, 0]
        result = at_states(tried.found, states).rows(rows[self.car[rows].argsort()])
        quality = replace(result.quality, probability_heading=probability_of_sense(cost, forward, best))
        numbers = torch.arange(len(best), device=best.device)
        return replace(result, quality=quality), self.T_cam_obj[numbers, best]

    def _costs(self, tried: Refined[CarState]) -> tuple[Tensor, Tensor, Tensor]:
        """Costs (B, C), directions of the front in the camera's frame (B, C, 3), and whether results are refused.

        The cost is infinite where no candidate is tried.
        """
        minimum, names = tried.minimum, tried.problem.term_names
        left_out = torch.tensor([name in PhotometricEvidence.names for name in names], device=self.car.device)
        cost = minimum.after.term_costs.masked_fill(left_out, 0.0).sum(dim=1)
        cost = cost.masked_fill(cost.isnan(), torch.inf)

        def of_all(values: Tensor, nothing: float | bool) -> Tensor:
            table = values.new_full((*self.in_view.shape, *values.shape[1:]), nothing)
            return table.index_put((self.car, self.number), values)

        # The first row of R_obj_cam is the object's x axis in the camera's frame.
        forward, refused = minimum.end.T_obj_cam[:, 0, :3], ~is_refined(minimum.status)
        return of_all(cost, torch.inf), of_all(forward, 0.0), of_all(refused, True)


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
