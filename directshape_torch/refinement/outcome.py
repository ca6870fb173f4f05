"""How the result of a call is made: cars as they came, what a minimisation says of them, and whether to believe it."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from directshape_torch.config import AcceptanceConfig
from directshape_torch.geometry import se3
from directshape_torch.numerics.records import kept
from directshape_torch.refinement.disparity_profile import (
    APART_PX,
    DisparityProfile,
    default_offsets,
    disparity_profile,
)
from directshape_torch.refinement.observability import (
    covariance_of,
    covariance_xyz_yaw,
    observability_of,
    without_offset,
)
from directshape_torch.refinement.problem import CarProblem, CarStage
from directshape_torch.refinement.quality import (
    EVIDENCE_NAMES,
    bundled_trust_model,
    evidence_of_costs,
    evidence_of_motion,
    fit_quality,
)
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.scene import Detections, FrameBatch
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.solver.gauss_newton import Minimum
from directshape_torch.solver.problem import where_rows
from directshape_torch.status import Status, is_refined
from directshape_torch.terms.cars import CarBatch, CarState
from directshape_torch.terms.priors import RIG_WEIGHT
from directshape_torch.terms.term import Evaluation, Figures

# Nine in ten cars whose cost settled promise less than this share of it.
_SETTLED_SHARE = 0.005
# Of 2300 rendered cars one has less, and boxes at half or twice the true depth have 0.62 at most.
_LEAST_MASK_IOU = 0.65
# Of these cars at least 0.68 of the pixels could be compared.
_LEAST_MATCHED_SHARE = 0.1
# The pixels of a car that is there have their best disparity where it ended, and know it to this many pixels. Most
# boxes and masks that are laid on other images fail in this (scripts/calibrate_fusion.py, column "elsewhere").
_LARGEST_OFFSET_SIGMA_PX = 0.5
# Sigma along the viewing ray over the depth; of these cars at most 0.1.
_LARGEST_DEPTH_SHARE = 0.2


def as_they_came(
    prior: ShapePrior, frames: FrameBatch, detections: Detections, status_code: Tensor, term_names: tuple[str, ...]
) -> RefinementResult:
    """The result of B cars of which nothing is known but what they came with, and the statuses (B,) that say so."""
    count, T_cam_obj = len(detections), detections.T_cam_obj.clone()
    offsets = default_offsets(T_cam_obj)
    sizes: dict[int | str, int] = {"B": count, "D": 6 + prior.num_codes, "T": len(term_names), "iterations": 0}
    sizes |= {"E": len(EVIDENCE_NAMES), "n": len(offsets)}
    return RefinementResult.nothing(
        sizes,
        T_cam_obj,
        T_cam_obj=T_cam_obj,
        code=prior.initial_code(count).to(T_cam_obj),
        status_code=status_code,
        iterations=torch.zeros_like(status_code),
        term_names=term_names,
        profile=DisparityProfile.nothing(sizes, T_cam_obj, offsets_px=offsets),
        # The caller may reuse the tensor for the next call.
        input_dimensions_hwl=detections.dimensions_hwl.clone(),
        ground_source=_ground_sources(frames, detections),
        t_cam_ref=frames.camera.t_cam_ref[detections.frame_index],
        prior=prior,
    )


def _ground_sources(frames: FrameBatch, detections: Detections) -> tuple[str, ...]:
    """Where the plane of each car's frame came from; which frame that is the host asks only where it matters."""
    sources = frames.ground.source
    if len(set(sources)) == 1:
        return sources[:1] * len(detections)
    return tuple(sources[frame] for frame in detections.frame_index.tolist())


def going_on(result: RefinementResult, rows: Tensor, later: RefinementResult) -> RefinementResult:
    """The result with what a later minimisation says of the cars `rows` (R,), ascending.

    Terms that the earlier one did not have have cost the others nothing.
    """
    place = torch.tensor([later.term_names.index(name) for name in result.term_names], device=rows.device)
    before, after = (
        costs.new_zeros(len(result), len(later.term_names)).index_copy(1, place, costs)
        for costs in (result.cost_before, result.cost_after)
    )
    history = later.cost_history.new_full((len(result), later.cost_history.shape[1]), torch.nan)
    history = torch.cat([result.cost_history, history.index_copy(0, rows, later.cost_history)], dim=1)
    done = result.iterations.index_add(0, rows, later.iterations)
    result = replace(result, term_names=later.term_names, cost_before=before, cost_after=after).put(rows, later)
    return replace(result, iterations=done, cost_history=history)


def at_states(result: RefinementResult, state: CarState) -> RefinementResult:
    """The result at its final states; what is said of a car that is not there is not known."""
    status, refined = result.status_code, result.refined
    figures_known = refined | (status == Status.not_trusted.code) | (status == Status.no_evidence.code)
    # The input pose is returned to the bit for cars that were not refined, not inverted twice.
    T_cam_obj = torch.where(refined[:, None, None], se3.inverse(state.T_obj_cam), result.T_cam_obj)
    return replace(
        result,
        T_cam_obj=T_cam_obj,
        code=state.code,
        covariance=kept(result.covariance, refined),
        covariance_xyz_yaw=kept(result.covariance_xyz_yaw, refined),
        quality=result.quality.where(figures_known),
        observability=result.observability.where(refined),
        profile=result.profile.where(figures_known),
    )


def outcome_of(
    problem: CarProblem, initial: CarState, minimum: Minimum[CarState], cars: CarBatch, came: RefinementResult
) -> RefinementResult:
    """What `came` becomes at a minimum: costs, covariance, quality, observability and profile.

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
    seen = stage.information_of_measurements(after)
    if seen is not None:
        seen = without_offset(problem.sharing.with_others(seen, refined), num_kept)
    unseen = observability_of(problem.prior, end, seen)
    found = replace(
        came,
        status_code=minimum.status,
        iterations=minimum.iterations,
        cost_history=minimum.cost_history,
        term_names=problem.term_names,
        cost_before=before.term_costs,
        cost_after=torch.where(refined[:, None], after.term_costs, before.term_costs),
        covariance=covariance,
        covariance_xyz_yaw=covariance_xyz_yaw(covariance, end.T_obj_cam),
        # The directions are mostly those of the depth, so its factor brings them to size.
        observability=replace(unseen, sigmas_m=bundled_trust_model().sigma_factors[0] * unseen.sigmas_m),
        profile=disparity_profile(stage.photometric, at_input, at_end, len(cars), end.code),
    )
    evidence = evidence_of_motion(problem, cars, initial, end, covariance, found.covariance_xyz_yaw)
    evidence |= evidence_of_costs(found.cost_before, found.cost_after, found.profile)
    return replace(found, quality=fit_quality(stage, after, minimum.seen_end, evidence))


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


def judged(
    minimum: Minimum[CarState], initial: CarState, found: RefinementResult, limits: AcceptanceConfig
) -> tuple[Minimum[CarState], RefinementResult]:
    """Both with the statuses that the figures give, the minimum with the input of cars that they speak against.

    A probability that is not known is no reason to return the input, evidence that is missing is one.
    """
    status = minimum.status
    # The iterations may run out where there is nothing left to gain.
    settled = (status == Status.max_iterations.code) & (promised_decrease(minimum) < _SETTLED_SHARE)
    status = torch.where(settled, Status.converged.code, status)
    unseen = is_refined(status) & ~has_evidence(minimum.end, found)
    status = torch.where(unseen, Status.no_evidence.code, status)
    # What the model of trust has learnt does not hold where there is nothing to see.
    better, not_worse = (
        probability.masked_fill(unseen, torch.nan)
        for probability in (found.quality.probability_better, found.quality.probability_not_worse)
    )
    doubtful, risky = better < limits.min_probability_better, not_worse < limits.min_probability_not_worse
    status = torch.where(is_refined(status) & (doubtful | risky), Status.not_trusted.code, status)
    state = where_rows(is_refined(status), minimum.state, initial)
    quality = replace(found.quality, probability_better=better, probability_not_worse=not_worse)
    return replace(minimum, state=state, status=status), replace(found, status_code=status, quality=quality)


def promised_decrease(minimum: Minimum[CarState]) -> Tensor:
    """What a Gauss-Newton step from where the iterations ended promises (B,), as a share of the cost there."""
    after = minimum.after
    gradient, hessian = after.gradient.sum(dim=1), after.hessian.sum(dim=1)
    at = minimum.stage.without_held(Evaluation(after.cost, gradient, hessian, ()))
    share, members = minimum.stage.problem.sharing, is_refined(minimum.status)
    step, solvable = share.damped_step(at.hessian, at.gradient, torch.zeros_like(at.cost), members)
    promised = -0.5 * share.total((at.gradient * step).sum(dim=1), members) / share.total(at.cost, members)
    return torch.where(solvable, promised, torch.inf)


def has_evidence(end: CarState, found: RefinementResult) -> Tensor:
    """Whether the images confirm the states (B,) at the end: masks, compared pixels that match there, a known depth."""
    quality, location = found.quality, se3.inverse(end.T_obj_cam)[:, :3, 3]
    left = quality.mask_iou_left
    iou = torch.where(left.isnan(), quality.mask_iou_right, left)
    depth_share = _sigma_along(found.covariance_xyz_yaw, location) / location[:, 2]
    seen = depth_share < _LARGEST_DEPTH_SHARE  # a comparison with NaN is false
    if "silhouette_left" in found.term_names:
        seen = seen & (iou >= _LEAST_MASK_IOU)
    if "photometric" in found.term_names:
        # Its pixels are those of the left mask.
        at_end = found.profile.after
        is_there = (at_end.offset_px.abs() < APART_PX) & (at_end.sigma_px < _LARGEST_OFFSET_SIGMA_PX)
        seen = seen & (((quality.matched_share >= _LEAST_MATCHED_SHARE) & is_there) | left.isnan())
    return seen


def _sigma_along(covariance_xyz_yaw: Tensor, location: Tensor) -> Tensor:
    """Calibrated standard deviation (B,) along the viewing rays."""
    C = bundled_trust_model().calibrated_covariance(covariance_xyz_yaw, location)[:, :3, :3]
    ray = location.to(C)
    ray = ray / ray.norm(dim=1, keepdim=True)
    variance: Tensor = (ray[:, None] @ C @ ray[..., None])[:, 0, 0]
    return variance.sqrt()
