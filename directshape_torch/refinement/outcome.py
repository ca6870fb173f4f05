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
from directshape_torch.refinement.fusion import chances, compared
from directshape_torch.refinement.observability import (
    covariance_of,
    covariance_xyz_yaw,
    observability_of,
    without_offset,
)
from directshape_torch.refinement.problem import CarProblem, CarStage
from directshape_torch.refinement.quality import fit_quality
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.refinement.trust import EVIDENCE_NAMES, bundled_trust_model
from directshape_torch.scene import Detections, FrameBatch
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.solver.gauss_newton import Minimum
from directshape_torch.solver.problem import where_rows
from directshape_torch.solver.sharing import INDEPENDENT
from directshape_torch.state.cars import CarBatch
from directshape_torch.state.unknowns import CODE, POSE, AnyState, State, Unknowns, blocks_of_car
from directshape_torch.status import Status, is_refined
from directshape_torch.terms.priors import RIG_WEIGHT
from directshape_torch.terms.term import Evaluation, Figures

_REFUSED = (Status.not_trusted, Status.mask_missed, Status.no_match, Status.depth_unknown, Status.no_car)
# Nine in ten cars whose cost settled promise less than this share of it.
_SETTLED_SHARE = 0.005
# Of 2300 rendered cars one has less, and boxes at half or twice the true depth have 0.62 at most.
_LEAST_MASK_IOU = 0.65
# Of these cars at least 0.68 of the pixels could be compared.
_LEAST_MATCHED_SHARE = 0.1
# The pixels of a car that is there have their best disparity where it ended, and know it to this many pixels. Most
# boxes and masks that are laid on other images fail in this (scripts/calibrate_trust.py, column "elsewhere").
_LARGEST_OFFSET_SIGMA_PX = 0.5
# A mask whose car is there with less probability rather shows another car or none.
_LEAST_IS_THERE = 0.5
# Sigma along the viewing ray over the depth; of these cars at most 0.1.
_LARGEST_DEPTH_SHARE = 0.2


def as_they_came(
    prior: ShapePrior, frames: FrameBatch, detections: Detections, status_code: Tensor, term_names: tuple[str, ...]
) -> RefinementResult:
    """The result of B cars of which nothing is known but what they came with, and the statuses (B,) that say so."""
    count, T_cam_obj = len(detections), detections.T_cam_obj.clone()
    offsets = default_offsets(T_cam_obj)
    sizes: dict[int | str, int] = {
        "B": count,
        "D": Unknowns(blocks_of_car(prior.num_codes, 0)).size,
        "T": len(term_names),
        "iterations": 0,
    }
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


def at_states(result: RefinementResult, state: State) -> RefinementResult:
    """The result at its final states; what is said of a car that is not there is not known."""
    status, refined = result.status_code, result.refined
    figures_known = refined | torch.stack([status == each.code for each in _REFUSED]).any(dim=0)
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
        comparison=replace(
            result.comparison.where(refined),
            distance_in_sigmas=kept(result.comparison.distance_in_sigmas, figures_known),
        ),
    )


def outcome_of(
    problem: CarProblem, minimum: Minimum[AnyState], cars: CarBatch, came: RefinementResult
) -> RefinementResult:
    """What `came` becomes at a minimum: costs, covariance, quality, observability and profile.

    All of them where the iterations ended; cars that the solver gave their input back show nothing of it in a result
    but their costs.
    """
    end, refined = minimum.end, is_refined(minimum.status)
    stage: CarStage = minimum.stage
    before, after = minimum.before, _of_calibrated_rig(problem, minimum.after)
    kept = end.unknowns.span(POSE, CODE)
    # What the other views of a track say of its shape.
    information = problem.sharing.with_others(after.information.sum(dim=1), refined)
    covariance = covariance_of(information)[:, kept, kept] + _of_field(end, cars)
    at_input, at_end = (None if at is None else at.where for at in map(stage.photometric_part, (before, after)))
    seen = stage.information_of_measurements(after)
    if seen is not None:
        seen = without_offset(problem.sharing.with_others(seen, refined), kept)
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
        # The directions are mostly those of the depth, so its factor brings them to size.
        observability=replace(unseen, sigmas_m=_depth_factor() * unseen.sigmas_m),
        profile=disparity_profile(stage.photometric, at_input, at_end, len(cars), end.code),
    )
    of_images = _at_end(found, end)
    comparison = compared(of_images, cars, bundled_trust_model().image_noise)
    # Views of a track are not brought together with their detections.
    chance = chances(of_images, comparison, brings_together=problem.sharing is INDEPENDENT)
    apart, distance = found.profile.halves_apart, comparison.distance_in_sigmas
    quality = fit_quality(stage, after, minimum.seen_end, apart, distance, chance)
    return _placed(replace(found, comparison=comparison, quality=quality), end)


def of_views_of_tracks(found: RefinementResult, end: State, cars: CarBatch) -> RefinementResult:
    """The result of views of a track with what is known of the images' boxes, which they keep."""
    alone = compared(_at_end(found, end), replace(cars, detector_noise=None), bundled_trust_model().image_noise)
    # What the detector is off by is learnt from cars that are by themselves.
    nothing, distance = torch.full_like(alone.difference, torch.nan), found.comparison.distance_in_sigmas
    return _placed(replace(found, comparison=replace(alone, difference=nothing, distance_in_sigmas=distance)), end)


def _placed(found: RefinementResult, end: State) -> RefinementResult:
    """The result with the covariance of place and heading that follows from its comparison."""
    location = se3.inverse(end.T_obj_cam)[:, :3, 3]
    return replace(found, covariance_xyz_yaw=covariance_xyz_yaw(found.comparison.covariance, location))


def _at_end(found: RefinementResult, end: State) -> RefinementResult:
    """The result with every car where its iterations ended, refined or not."""
    status = torch.full_like(found.status_code, Status.converged.code)
    return replace(found, T_cam_obj=se3.inverse(end.T_obj_cam), code=end.code, status_code=status)


def _depth_factor() -> float:
    """What brings the uncalibrated standard deviations of the depth to size."""
    return bundled_trust_model().image_noise.factors[0]


def _of_field(end: State, cars: CarBatch) -> Tensor:
    """What the covariance (B, 6 + K, 6 + K) owes to the field, whose error moves a car along its viewing ray."""
    origin = se3.inverse(end.T_obj_cam)[:, :3, 3]
    disparity = cars.focal_baseline / origin[:, 2]
    shift_cam = origin * (cars.field_sigma_px / disparity)[:, None]
    # The origin moves by -R_cam_obj v.
    v = -(end.T_obj_cam[:, :3, :3] @ shift_cam[..., None])[..., 0].to(torch.float64)
    moved_obj = end.unknowns.only(POSE, CODE).placed(torch.nn.functional.pad(v, (0, 3)), (POSE,))
    return moved_obj[:, :, None] * moved_obj[:, None]


def _of_calibrated_rig(problem: CarProblem, figures: Figures) -> Figures:
    """The rig's part of the information in units that the calibration of depth brings to the sigma that was given."""
    if "rig" not in problem.term_names:
        return figures
    factor = torch.ones_like(figures.term_costs)
    factor[:, problem.term_names.index("rig")] = _depth_factor() ** 2 / RIG_WEIGHT
    return figures._replace(information=figures.information * factor[..., None, None])


def judged(
    minimum: Minimum[AnyState], initial: AnyState, found: RefinementResult, limits: AcceptanceConfig
) -> tuple[Minimum[AnyState], RefinementResult]:
    """Both with the statuses that the figures give, the minimum with the input of cars that they speak against.

    A probability that is not known is no reason to return the input, evidence that is missing is one.
    """
    status = minimum.status
    # The iterations may run out where there is nothing left to gain.
    settled = (status == Status.max_iterations.code) & (promised_decrease(minimum) < _SETTLED_SHARE)
    status = torch.where(settled, Status.converged.code, status)
    refusal = refusal_of(found)
    unseen = is_refined(status) & (refusal >= 0)
    status = torch.where(unseen, refusal, status)
    # What the model of trust has learnt does not hold where there is nothing to see.
    better, not_worse = (
        probability.masked_fill(unseen, torch.nan)
        for probability in (found.quality.probability_better, found.quality.probability_not_worse)
    )
    doubtful, risky = better < limits.min_probability_better, not_worse < limits.min_probability_not_worse
    is_there = bundled_trust_model().car_is_there(found.quality.evidence)
    reason = torch.where(is_there < _LEAST_IS_THERE, Status.no_car.code, Status.not_trusted.code)
    status = torch.where(is_refined(status) & (doubtful | risky), reason, status)
    state = where_rows(is_refined(status), minimum.state, initial)
    quality = replace(found.quality, probability_better=better, probability_not_worse=not_worse)
    return replace(minimum, state=state, status=status), replace(found, status_code=status, quality=quality)


def promised_decrease(minimum: Minimum[AnyState]) -> Tensor:
    """What a Gauss-Newton step from where the iterations ended promises (B,), as a share of the cost there."""
    after = minimum.after
    gradient, hessian = after.gradient.sum(dim=1), after.hessian.sum(dim=1)
    at = minimum.stage.without_held(Evaluation(after.cost, gradient, hessian, ()))
    share, members = minimum.stage.problem.sharing, is_refined(minimum.status)
    step, solvable = share.damped_step(at.hessian, at.gradient, torch.zeros_like(at.cost), members)
    promised = -0.5 * share.total((at.gradient * step).sum(dim=1), members) / share.total(at.cost, members)
    return torch.where(solvable, promised, torch.inf)


def refusal_of(found: RefinementResult) -> Tensor:
    """The status (B,) of states that the images do not confirm, else -1: masks, pixels that match, a known depth."""
    quality, status = found.quality, torch.full_like(found.status_code, -1)
    depth_share = found.comparison.sigma_images[:, 0] / found.comparison.distance
    # Comparisons with NaN are false.
    status = status.masked_fill(~(depth_share < _LARGEST_DEPTH_SHARE), Status.depth_unknown.code)
    left = quality.mask_iou_left
    if "photometric" in found.term_names:
        at_end = found.profile.after
        is_there = (at_end.offset_px.abs() < APART_PX) & (at_end.sigma_px < _LARGEST_OFFSET_SIGMA_PX)
        # Its pixels are those of the left mask.
        seen = ((quality.matched_share >= _LEAST_MATCHED_SHARE) & is_there) | left.isnan()
        status = status.masked_fill(~seen, Status.no_match.code)
    if "silhouette_left" in found.term_names:
        iou = torch.where(left.isnan(), quality.mask_iou_right, left)
        status = status.masked_fill(~(iou >= _LEAST_MASK_IOU), Status.mask_missed.code)
    return status
