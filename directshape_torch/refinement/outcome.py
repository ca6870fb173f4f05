"""What a minimisation says of its cars, and the result of a call that it becomes a part of."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from directshape_torch.config import AcceptanceConfig
from directshape_torch.geometry import se3
from directshape_torch.numerics.records import CarRecord, placed
from directshape_torch.refinement.disparity_profile import DisparityProfile, disparity_profile
from directshape_torch.refinement.observability import (
    Observability,
    covariance_of,
    covariance_xyz_yaw,
    observability_of,
    without_offset,
)
from directshape_torch.refinement.problem import CarProblem, CarStage
from directshape_torch.refinement.quality import Course, FitQuality, bundled_trust_model, fit_quality
from directshape_torch.solver.gauss_newton import Minimum
from directshape_torch.solver.problem import where_rows
from directshape_torch.status import Status, is_refined
from directshape_torch.terms.cars import CarBatch, CarState
from directshape_torch.terms.priors import RIG_WEIGHT, detector_pose_sigma
from directshape_torch.terms.term import Evaluation, Figures

# Nine in ten cars whose cost settled promise less than this share of it.
_SETTLED_SHARE = 0.005
# Of 2300 rendered cars one has less, and boxes at half or twice the true depth have 0.62 at most.
_LEAST_MASK_IOU = 0.65
# Of these cars at least 0.68 of the pixels could be compared.
_LEAST_MATCHED_SHARE = 0.1
# Sigma along the viewing ray over the depth; of these cars at most 0.1.
_LARGEST_DEPTH_SHARE = 0.2


@dataclass(frozen=True)
class Outcome(CarRecord):
    """What is said of the R cars that could be refined; fields as in `RefinementResult`."""

    state: CarState
    status: Tensor
    iterations: Tensor
    cost_history: Tensor
    term_names: tuple[str, ...]
    cost_before: Tensor
    cost_after: Tensor
    covariance: Tensor
    covariance_xyz_yaw: Tensor
    quality: FitQuality
    observability: Observability
    profile: DisparityProfile
    track_part: Tensor
    has_shape: bool = True

    @classmethod
    def nothing(cls, problem: CarProblem, state: CarState) -> Outcome:
        """The outcome of B cars of which nothing is known but their state."""
        count, unknowns = len(state.code), 6 + state.code.shape[1]
        nan = torch.full((count,), torch.nan, dtype=torch.float64, device=state.code.device)
        none = torch.zeros_like(nan, dtype=torch.long)
        names = problem.term_names
        return cls(
            state=state,
            status=none,
            iterations=none,
            cost_history=nan[:, None][:, :0],
            term_names=names,
            cost_before=nan[:, None].expand(-1, len(names)),
            cost_after=nan[:, None].expand(-1, len(names)),
            covariance=nan[:, None, None].expand(-1, unknowns, unknowns),
            covariance_xyz_yaw=nan[:, None, None].expand(-1, 4, 4),
            quality=FitQuality.nothing(nan, count),
            observability=Observability.nothing(nan, count),
            profile=DisparityProfile.nothing(nan, count),
            track_part=none - 1,
        )

    def with_columns(self, names: tuple[str, ...]) -> Outcome:
        """With costs in the columns of these names, 0 in those that it has not."""
        place = torch.tensor([names.index(name) for name in self.term_names], device=self.status.device)

        def placed_in(costs: Tensor) -> Tensor:
            return costs.new_zeros(len(costs), len(names)).index_copy(1, place, costs)

        before, after = placed_in(self.cost_before), placed_in(self.cost_after)
        return replace(self, term_names=names, cost_before=before, cost_after=after)

    def going_on(self, rows: Tensor, later: Outcome) -> Outcome:
        """The outcome with the figures of a later minimisation of the cars `rows` (R,), ascending; the state stays."""
        done = self.iterations.index_add(0, rows, later.iterations)
        history = torch.cat([self.cost_history, placed(later.cost_history, rows, len(self.status))], dim=1)
        return replace(self.put(rows, later), iterations=done, cost_history=history)


def outcome_of(problem: CarProblem, initial: CarState, minimum: Minimum[CarState], cars: CarBatch) -> Outcome:
    """Costs, covariance, quality, observability and profile of the cars of a problem at its minimum.

    All of them where the iterations ended; cars that the solver gave their input back show nothing of it in a result
    but their costs.
    """
    end, refined = minimum.end, is_refined(minimum.status)
    stage: CarStage = minimum.stage
    before, after = minimum.before, _of_calibrated_rig(problem, minimum.after)
    num_kept = 6 + end.code.shape[1]
    # What the other views of a track say of its shape.
    information = problem.sharing.with_others(after.information.sum(dim=1), refined)
    covariance = covariance_of(information)[:, :num_kept, :num_kept] + _of_field(end, cars)
    at_input, at_end = (None if at is None else at.where for at in map(stage.photometric_part, (before, after)))
    course = Course(
        stage=stage,
        before=initial,
        after=end,
        detector_hwl=cars.detector_hwl,
        cost_before=before.term_costs,
        cost_after=torch.where(refined[:, None], after.term_costs, before.term_costs),
        figures=after,
        seen=minimum.seen_end,
        covariance=covariance,
        covariance_xyz_yaw=covariance_xyz_yaw(covariance, end.T_obj_cam),
        profile=disparity_profile(stage.photometric, at_input, at_end, len(cars), end.code),
        detector_sigma=detector_pose_sigma(problem.config.priors, cars)[:, 0].detach(),
    )
    seen = stage.information_of_measurements(after)
    if seen is not None:
        seen = without_offset(problem.sharing.with_others(seen, refined), num_kept)
    unseen = observability_of(problem.prior, end, seen)
    return Outcome(
        state=minimum.state,
        status=minimum.status,
        iterations=minimum.iterations,
        cost_history=minimum.cost_history,
        term_names=problem.term_names,
        cost_before=course.cost_before,
        cost_after=course.cost_after,
        covariance=covariance,
        covariance_xyz_yaw=course.covariance_xyz_yaw,
        quality=fit_quality(course),
        # The directions are mostly those of the depth, so its factor brings them to size.
        observability=unseen.scaled(bundled_trust_model().sigma_factors[0]),
        profile=course.profile,
        track_part=torch.full_like(minimum.status, -1),
    )


def _of_field(end: CarState, cars: CarBatch) -> Tensor:
    """What the covariance (B, 6 + K, 6 + K) owes to the field, whose error moves a car along its viewing ray."""
    origin = se3.inverse(end.T_obj_cam)[:, :3, 3]
    disparity = cars.focal_baseline / origin[:, 2]
    shift_cam = origin * (cars.field_sigma_px / disparity)[:, None]
    # The origin moves by -R_cam_obj v.
    v = -(end.T_obj_cam[:, :3, :3] @ shift_cam[..., None])[..., 0].to(torch.float64)
    moved_obj = torch.nn.functional.pad(v, (0, 3 + end.code.shape[1]))
    return moved_obj[:, :, None] * moved_obj[:, None]


def _of_calibrated_rig(problem: CarProblem, figures: Figures) -> Figures:
    """The rig's part of the information in units that the calibration of depth brings to the sigma that was given."""
    if not problem.num_offsets:
        return figures
    factor = torch.ones_like(figures.term_costs)
    factor[:, problem.term_names.index("rig")] = bundled_trust_model().sigma_factors[0] ** 2 / RIG_WEIGHT
    return figures._replace(information=figures.information * factor[..., None, None])


def judged(minimum: Minimum[CarState], initial: CarState, outcome: Outcome, limits: AcceptanceConfig) -> Outcome:
    """The outcome with the statuses that the figures give, and the input's state for cars that they speak against.

    A probability that is not known is no reason to return the input, evidence that is missing is one.
    """
    status, end = minimum.status, minimum.end
    # The iterations may run out where there is nothing left to gain.
    settled = (status == Status.max_iterations.code) & (promised_decrease(minimum) < _SETTLED_SHARE)
    status = torch.where(settled, Status.converged.code, status)
    unseen = is_refined(status) & ~has_evidence(end, outcome)
    status = torch.where(unseen, Status.no_evidence.code, status)
    # What the model of trust has learnt does not hold where there is nothing to see.
    quality = replace(
        outcome.quality,
        probability_better=outcome.quality.probability_better.masked_fill(unseen, torch.nan),
        probability_not_worse=outcome.quality.probability_not_worse.masked_fill(unseen, torch.nan),
    )
    doubtful = quality.probability_better < limits.min_probability_better
    risky = quality.probability_not_worse < limits.min_probability_not_worse
    status = torch.where(is_refined(status) & (doubtful | risky), Status.not_trusted.code, status)
    state = where_rows(is_refined(status), minimum.state, initial)
    return replace(outcome, status=status, state=state, quality=quality)


def promised_decrease(minimum: Minimum[CarState]) -> Tensor:
    """What a Gauss-Newton step from where the iterations ended promises (B,), as a share of the cost there."""
    after = minimum.after
    gradient, hessian = after.gradient.sum(dim=1), after.hessian.sum(dim=1)
    at = minimum.stage.without_held(Evaluation(after.cost, gradient, hessian, ()))
    share, members = minimum.stage.problem.sharing, is_refined(minimum.status)
    step, solvable = share.damped_step(at.hessian, at.gradient, torch.zeros_like(at.cost), members)
    promised = -0.5 * share.total((at.gradient * step).sum(dim=1), members) / share.total(at.cost, members)
    return torch.where(solvable, promised, torch.inf)


def has_evidence(end: CarState, outcome: Outcome) -> Tensor:
    """Whether the images confirm the states (B,) at the end: masks, compared pixels, a depth that is known."""
    quality, location = outcome.quality, se3.inverse(end.T_obj_cam)[:, :3, 3]
    left = quality.mask_iou_left
    iou = torch.where(left.isnan(), quality.mask_iou_right, left)
    depth_share = _sigma_along(outcome.covariance_xyz_yaw, location) / location[:, 2]
    seen = depth_share < _LARGEST_DEPTH_SHARE  # a comparison with NaN is false
    if "silhouette_left" in outcome.term_names:
        seen = seen & (iou >= _LEAST_MASK_IOU)
    if "photometric" in outcome.term_names:
        # Its pixels are those of the left mask.
        seen = seen & ((quality.matched_share >= _LEAST_MATCHED_SHARE) | left.isnan())
    return seen


def _sigma_along(covariance_xyz_yaw: Tensor, location: Tensor) -> Tensor:
    """Calibrated standard deviation (B,) along the viewing rays."""
    C = bundled_trust_model().calibrated_covariance(covariance_xyz_yaw, location)[:, :3, :3]
    ray = location.to(C)
    ray = ray / ray.norm(dim=1, keepdim=True)
    variance: Tensor = (ray[:, None] @ C @ ray[..., None])[:, 0, 0]
    return variance.sqrt()
