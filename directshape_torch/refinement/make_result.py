"""This module makes the result of a call from the input and the minimum, and decides which cars to trust."""

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
from directshape_torch.refinement.problem import CarMinimum, CarProblem, stage_of
from directshape_torch.refinement.quality import fit_quality
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.refinement.trust import EVIDENCE_NAMES, bundled_trust_model
from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import FrameBatch
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.solver.problem import where_rows
from directshape_torch.solver.sharing import INDEPENDENT
from directshape_torch.state.cars import CarBatch
from directshape_torch.state.unknowns import CODE, POSE, AnyState, State, Unknowns, blocks_of_car
from directshape_torch.status import Status, is_refined
from directshape_torch.terms.priors import RIG_WEIGHT
from directshape_torch.terms.term import Evaluation, Figures

_REFUSED = (Status.not_trusted, Status.mask_missed, Status.no_match, Status.depth_unknown, Status.no_car)
# A further step promises less than this share of the cost for nine in ten cars whose cost has settled.
_SETTLED_SHARE = 0.005
# One of 2300 rendered cars has a lower IoU. Boxes at half or twice the true depth have 0.62 at most.
_LEAST_MASK_IOU = 0.65
# At least 0.68 of the pixels of each of the 2300 rendered cars could be compared.
_LEAST_MATCHED_SHARE = 0.1
# If a car is there, its pixels have their best disparity where the refinement ended, with at most this standard
# deviation in pixels. Most boxes and masks that are laid on other images fail this test (scripts/calibrate_trust.py,
# column "returned on other images").
_LARGEST_OFFSET_SIGMA_PX = 0.5
# If a car is there with a lower probability, its mask more likely shows another car or none.
_LEAST_IS_THERE = 0.5
# This limits sigma along the viewing ray divided by the depth. It is at most 0.1 for the 2300 rendered cars.
_LARGEST_DEPTH_SHARE = 0.2


def unrefined_result(
    prior: ShapePrior, frames: FrameBatch, detections: Detections, status_code: Tensor, term_names: tuple[str, ...]
) -> RefinementResult:
    """The result of B cars of which only the input and the statuses (B,) are known."""
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
        # The result holds a copy, because the caller may reuse the tensor for the next call.
        input_dimensions_hwl=detections.dimensions_hwl.clone(),
        ground_source=_ground_sources(frames, detections),
        t_cam_ref=frames.camera.t_cam_ref[detections.frame_index],
        prior=prior,
    )


def _ground_sources(frames: FrameBatch, detections: Detections) -> tuple[str, ...]:
    """The source of the ground plane of each car; frame numbers are read from the device only if sources differ."""
    sources = frames.ground.source
    if len(set(sources)) == 1:
        return sources[:1] * len(detections)
    return tuple(sources[frame] for frame in detections.frame_index.tolist())


def going_on(result: RefinementResult, rows: Tensor, later: RefinementResult) -> RefinementResult:
    """The result with what a later minimisation says of the cars `rows` (R,), which ascend.

    Terms that only one of both has get a cost of 0 for the cars of the other.
    """
    names = tuple(dict.fromkeys((*later.term_names, *result.term_names)))
    result, later = (_with_terms(each, names) for each in (result, later))
    history = later.cost_history.new_full((len(result), later.cost_history.shape[1]), torch.nan)
    history = torch.cat([result.cost_history, history.index_copy(0, rows, later.cost_history)], dim=1)
    done = result.iterations.index_add(0, rows, later.iterations)
    return replace(result.put(rows, later), iterations=done, cost_history=history)


def _with_terms(result: RefinementResult, names: tuple[str, ...]) -> RefinementResult:
    """The result with the costs of the named terms, which include its own."""
    place = torch.tensor([names.index(name) for name in result.term_names], device=result.status_code.device)
    before, after = (
        costs.new_zeros(len(result), len(names)).index_copy(1, place, costs)
        for costs in (result.cost_before, result.cost_after)
    )
    return replace(result, term_names=names, cost_before=before, cost_after=after)


def at_states(result: RefinementResult, state: State) -> RefinementResult:
    """The result at its final states; figures of cars that were not refined become NaN, except for refused cars."""
    status, refined = result.status_code, result.refined
    figures_known = refined | torch.stack([status == each.code for each in _REFUSED]).any(dim=0)
    # Cars that were not refined get exactly their input pose. Two inversions would change its last bits.
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


def result_of(
    problem: CarProblem, minimum: CarMinimum[AnyState], cars: CarBatch, unrefined: RefinementResult
) -> RefinementResult:
    """The result `unrefined` with costs, covariance, quality, observability and profile of a minimum.

    All figures belong to the states where the iterations ended. For cars that get their input back a result keeps only
    the costs of the input.
    """
    end, refined = minimum.end, is_refined(minimum.status)
    stage = stage_of(minimum)
    before, after = minimum.before, _of_calibrated_rig(problem, minimum.after)
    kept = end.unknowns.span(POSE, CODE)
    # The other views of a track add what they say of its shape.
    information = problem.sharing.with_others(after.information.sum(dim=1), refined)
    covariance = covariance_of(information)[:, kept, kept] + _of_field(end, cars)
    at_input, at_end = (None if at is None else at.anchor for at in map(stage.photometric_part, (before, after)))
    seen = stage.information_of_measurements(after)
    if seen is not None:
        seen = without_offset(problem.sharing.with_others(seen, refined), kept)
    unseen = observability_of(problem.prior, end, seen)
    found = replace(
        unrefined,
        status_code=minimum.status,
        iterations=minimum.iterations,
        cost_history=minimum.cost_history,
        term_names=problem.term_names,
        cost_before=before.term_costs,
        cost_after=torch.where(refined[:, None], after.term_costs, before.term_costs),
        covariance=covariance,
        # The weak directions consist mostly of depth, so the factor of the depth calibrates them.
        observability=replace(unseen, sigmas_m=_depth_factor() * unseen.sigmas_m),
        profile=disparity_profile(stage.photometric, at_input, at_end, len(cars), end.code),
    )
    of_images = _at_end(found, end)
    comparison = compared(of_images, cars, bundled_trust_model().image_noise)
    # Views of a track are not combined with their detections.
    chance = chances(of_images, comparison, brings_together=problem.sharing is INDEPENDENT)
    apart, distance = found.profile.halves_apart, comparison.distance_in_sigmas
    quality = fit_quality(stage, after, minimum.prepared_end, apart, distance, chance)
    return _placed(replace(found, comparison=comparison, quality=quality), end)


def of_views_of_tracks(found: RefinementResult, end: State, cars: CarBatch) -> RefinementResult:
    """The result of views of a track, whose comparison is for the images' boxes, because views keep these."""
    alone = compared(_at_end(found, end), replace(cars, detector_noise=None), bundled_trust_model().image_noise)
    # The errors of the detector are learnt only from cars that are in no track.
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
    """The factor that calibrates the standard deviations of the depth."""
    return bundled_trust_model().image_noise.factors[0]


def _of_field(end: State, cars: CarBatch) -> Tensor:
    """The part of the covariance (B, 6 + K, 6 + K) from the field, whose error moves a car along its viewing ray."""
    origin = se3.inverse(end.T_obj_cam)[:, :3, 3]
    disparity = cars.focal_baseline / origin[:, 2]
    shift_cam = origin * (cars.field_sigma_px / disparity)[:, None]
    # The origin moves by -R_cam_obj v.
    v = -(end.T_obj_cam[:, :3, :3] @ shift_cam[..., None])[..., 0].to(torch.float64)
    moved_obj = end.unknowns.only(POSE, CODE).placed(torch.nn.functional.pad(v, (0, 3)), (POSE,))
    return moved_obj[:, :, None] * moved_obj[:, None]


def _of_calibrated_rig(problem: CarProblem, figures: Figures) -> Figures:
    """The figures with the rig's information scaled so that the depth's calibration gives the sigma of the caller."""
    if "rig" not in problem.term_names:
        return figures
    factor = torch.ones_like(figures.term_costs)
    factor[:, problem.term_names.index("rig")] = _depth_factor() ** 2 / RIG_WEIGHT
    return figures._replace(information=figures.information * factor[..., None, None])


def judged(
    minimum: CarMinimum[AnyState],
    initial: AnyState,
    found: RefinementResult,
    limits: AcceptanceConfig,
    is_from_masks: Tensor | None = None,
) -> tuple[CarMinimum[AnyState], RefinementResult]:
    """Set the statuses by the figures, and give refused cars their input state back.

    An unknown probability does not refuse a car, but missing evidence does. A car whose box was made of its mask (B,)
    has no other box that could be better, so the probability that it is there decides alone.
    """
    status = minimum.status
    # If the iterations ran out where nothing is left to gain, the car has converged.
    settled = (status == Status.max_iterations.code) & (promised_decrease(minimum) < _SETTLED_SHARE)
    status = torch.where(settled, Status.converged.code, status)
    refusal = refusal_of(found)
    unseen = is_refined(status) & (refusal >= 0)
    status = torch.where(unseen, refusal, status)
    # The model of trust does not hold where the images do not confirm a car.
    better, not_worse = (
        probability.masked_fill(unseen, torch.nan)
        for probability in (found.quality.probability_better, found.quality.probability_not_worse)
    )
    doubtful, risky = better < limits.min_probability_better, not_worse < limits.min_probability_not_worse
    is_there = bundled_trust_model().car_is_there(found.quality.evidence)
    reason = torch.where(is_there < _LEAST_IS_THERE, Status.no_car.code, Status.not_trusted.code)
    if is_from_masks is not None:
        doubtful = doubtful | (is_from_masks & (is_there < limits.min_probability_better))
    status = torch.where(is_refined(status) & (doubtful | risky), reason, status)
    state = where_rows(is_refined(status), minimum.state, initial)
    quality = replace(found.quality, probability_better=better, probability_not_worse=not_worse)
    return replace(minimum, state=state, status=status), replace(found, status_code=status, quality=quality)


def promised_decrease(minimum: CarMinimum[AnyState]) -> Tensor:
    """The decrease (B,) that a Gauss-Newton step at the end promises, as a share of the cost at the end."""
    after = minimum.after
    gradient, hessian = after.gradient.sum(dim=1), after.hessian.sum(dim=1)
    stage, members = stage_of(minimum), is_refined(minimum.status)
    at, share = stage.without_held(Evaluation(after.cost, gradient, hessian, ())), stage.problem.sharing
    step, solvable = share.damped_step(at.hessian, at.gradient, torch.zeros_like(at.cost), members)
    promised = -0.5 * share.total((at.gradient * step).sum(dim=1), members) / share.total(at.cost, members)
    return torch.where(solvable, promised, torch.inf)


def refusal_of(found: RefinementResult) -> Tensor:
    """Status (B,) of states that mask, matching pixels or sigma of the depth refute; -1 for all other states."""
    quality, status = found.quality, torch.full_like(found.status_code, -1)
    depth_share = found.comparison.sigma_images[:, 0] / found.comparison.distance
    # Comparisons with NaN are false, so NaN refuses a car.
    status = status.masked_fill(~(depth_share < _LARGEST_DEPTH_SHARE), Status.depth_unknown.code)
    left = quality.mask_iou_left
    if "photometric" in found.term_names:
        at_end = found.profile.after
        is_there = (at_end.offset_px.abs() < APART_PX) & (at_end.sigma_px < _LARGEST_OFFSET_SIGMA_PX)
        # The photometric term has the pixels of the left mask, so it has none where there is no left mask.
        seen = ((quality.matched_share >= _LEAST_MATCHED_SHARE) & is_there) | left.isnan()
        status = status.masked_fill(~seen, Status.no_match.code)
    if "silhouette_left" in found.term_names:
        iou = torch.where(left.isnan(), quality.mask_iou_right, left)
        status = status.masked_fill(~(iou >= _LEAST_MASK_IOU), Status.mask_missed.code)
    return status
