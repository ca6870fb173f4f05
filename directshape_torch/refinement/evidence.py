"""How well a car fits what the images show, and what is known of how it came there: a `FitQuality` of the course.

The evidence is a row of numbers for each car, for the model of trust to read.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.geometry import se3
from directshape_torch.geometry.box3d import rotation_y_from_pose, viewing_axes, wrap_angle
from directshape_torch.numerics.tensors import constant_like
from directshape_torch.refinement.disparity_profile import DisparityProfile
from directshape_torch.refinement.observability import cholesky_of_regular
from directshape_torch.refinement.problem import CarStage
from directshape_torch.refinement.quality import EVIDENCE_NAMES, FitQuality, bundled_trust_model
from directshape_torch.rows import CarSums
from directshape_torch.shape.shape_prior import DimensionsDerivative
from directshape_torch.terms.cars import CarState
from directshape_torch.terms.photometric import Photometric
from directshape_torch.terms.silhouette import MaskRows
from directshape_torch.terms.term import Figures, Part, Sight

_TINY = 1e-9
# Round figures of the calibration: what the sigmas are short of, and the least errors of length, width and heading.
_SIGMA_FACTOR = 2.0
_SIGMA_FLOORS = (0.05, 0.04, 0.01, 0.1, 0.03)


@dataclass(frozen=True)
class Course:
    """The course of a refinement of B cars, as far as the evidence needs it."""

    stage: CarStage  # the last one
    before: CarState  # input
    after: CarState  # final state
    detector_hwl: Tensor  # (B, 3) metres, of the input
    cost_before: Tensor  # (B, T) at the final stage
    cost_after: Tensor  # likewise
    figures: Figures  # of the energy at the final state
    seen: Sight  # what the rays see there
    covariance: Tensor  # (B, D, D) in the tangent of `retract`, uncalibrated
    covariance_xyz_yaw: Tensor  # (B, 4, 4), uncalibrated
    unsettled: Tensor  # (B,) bool, the iterations ran out
    profile: DisparityProfile  # photometric cost over the disparity
    detector_sigma: Tensor  # (B,) metres, of the input along the viewing ray; not finite where nobody knows it


class Agreement(NamedTuple):
    """Agreement of B cars with the images, (B,) each; see `FitQuality`."""

    mask_iou_left: Tensor
    mask_iou_right: Tensor
    photometric_error_grey: Tensor
    matched_share: Tensor


@torch.no_grad()
def fit_quality(course: Course) -> FitQuality:
    """Figures of B cars at the end of a refinement."""
    stage = course.stage
    left, right = mask_ious(stage.problem.masks, course.seen)
    nan = torch.full_like(left, torch.nan)
    photometric, at = stage.photometric, stage.photometric_part(course.figures)
    both = (nan, nan) if photometric is None or at is None else photometric_agreement(photometric, at)
    agreed = Agreement(left, right, *both)
    evidence = evidence_of(course, agreed)
    better, not_worse = _probabilities(stage.problem.term_names, evidence)
    return FitQuality(*agreed, evidence, better, not_worse)


def _probabilities(term_names: Sequence[str], evidence: Tensor) -> tuple[Tensor, Tensor]:
    """Probabilities (B,) of a better and of a not worse box; the model knows the terms of the method "direct" alone."""
    if not {"silhouette_left", "photometric"} <= set(term_names) or "point_cloud" in term_names:
        unknown = torch.full_like(evidence[:, 0], torch.nan)
        return unknown, unknown
    model = bundled_trust_model()
    return model.better(evidence), model.not_worse(evidence)


def mask_ious(masks: MaskRows, seen: Sight) -> Tensor:
    """Overlap (2, B) of shape and mask over the pixels of the left and the right image."""
    distance = seen.field.value(seen.closest.points_obj, masks.rays.owner)
    counts = masks.filled.to(torch.float64)
    covered, masked = seen.closest.crosses & (distance < 0), masks.foreground > 0.5
    both, either = ((x * counts).sum(dim=1) for x in (covered & masked, covered | masked))
    num_cars = len(masks.blocks.counts)
    sums = CarSums.of(masks.rays.owner + num_cars * masks.side, 2 * num_cars)
    overlap, union = sums.sum(torch.stack([both, either], dim=1)).unbind(dim=1)
    return torch.where(union > 0, overlap / union, torch.nan).view(2, num_cars)


def photometric_agreement(term: Photometric, at: Part) -> tuple[Tensor, Tensor]:
    """Mean absolute residual (B,) in grey levels of the usable pixels, and their share (B,) of the pixel set."""
    fixed, usable = term.pixel_set, at.where.usable
    in_set = usable & (fixed.rows.pixel_weight > 0)
    weight = in_set[..., None] * fixed.rows.neighbour_weight.movedim(0, -1)
    per_block = [(weight * at.residual.abs()).sum(dim=(1, 2)), weight.sum(dim=(1, 2)), in_set.sum(dim=1)]
    table = torch.stack([x.to(torch.float64) for x in per_block], dim=1)
    error, total, compared = CarSums.of(fixed.blocks.owner, len(term.cars)).sum(table).unbind(dim=1)
    nothing = torch.full_like(total, torch.nan)
    share = torch.where(fixed.support > 0, compared / fixed.support.clamp_min(1), nothing)
    return torch.where(total > 0, error / total.clamp_min(1), nothing), share


def evidence_of(course: Course, agreement: Agreement) -> Tensor:
    """The evidence (B, E), float64, columns `EVIDENCE_NAMES`; NaN where a figure does not exist."""
    columns = {
        **_motion(course),
        **_agreement(course, agreement),
        **_costs(course),
        **_profile(course.profile),
    }
    return torch.stack([columns[name].to(torch.float64) for name in EVIDENCE_NAMES], dim=1)


def _motion(course: Course) -> dict[str, Tensor]:
    """How far the box moved, in metres, in shares of itself and in standard deviations."""
    T_obj_cam = torch.stack([course.before.T_obj_cam, course.after.T_obj_cam]).to(torch.float64)
    T_cam_obj = se3.inverse(T_obj_cam)
    T_before, T_after = T_cam_obj
    dimensions = course.stage.problem.prior.dimensions_and_derivative(course.after.code)
    hwl = dimensions.hwl.to(torch.float64)
    shift_cam = T_after[:, :3, 3] - T_before[:, :3, 3]
    heading_before, heading_after = rotation_y_from_pose(T_cam_obj)
    turned = wrap_angle(heading_after - heading_before)
    change_hwl = hwl - course.detector_hwl
    shift_obj = (shift_cam[:, None] @ T_after[:, :3, :3])[:, 0]
    motion = torch.cat([shift_obj[:, 0::2], turned[:, None], change_hwl[:, 1:].flip(1)], dim=1)
    misfit, gain = _expected(motion, _footprint_sigmas(course, dimensions), hwl)
    # Along and across the viewing ray on the ground, and the heading.
    J = torch.nn.functional.pad(viewing_axes(T_after[:, :3, 3])[:, :2], (0, 1, 0, 1))
    J[:, 2, 3] = 1
    in_view = (J @ torch.cat([shift_cam, turned[:, None]], dim=1)[..., None])[..., 0]
    covariance = J @ course.covariance_xyz_yaw @ J.mT
    log_sigma = 0.5 * covariance.diagonal(dim1=1, dim2=2).clamp_min(_TINY**2).log()
    return {
        "log_depth": (T_after[:, 2, 3].clamp_min(1.0) / 20).log(),
        "log_sigma_depth": log_sigma[:, 0],
        "log_sigma_side": log_sigma[:, 1],
        "log_sigma_yaw": log_sigma[:, 2],
        "log_expected_misfit": misfit.log(),
        "log_expected_gain": (gain + 0.005).log(),
        "moved_depth": in_view[:, 0].abs(),
        "turned": turned.abs(),
        "log_moved_sigmas": torch.log1p(_mahalanobis(in_view, covariance)),
        "length_change": change_hwl[:, 2].abs(),
        "code_size": course.after.code.square().mean(1).sqrt(),
        "log_detector_sigma": _detector_sigma(course.detector_sigma, T_before[:, 2, 3]),
    }


def _detector_sigma(sigma: Tensor, depth: Tensor) -> Tensor:
    """Logarithm of the share (B,) of the depth; NaN where nobody knows it."""
    known = sigma.isfinite() & (sigma > 0)
    return torch.where(known, (sigma.to(depth) / depth.clamp_min(1.0)).log(), torch.nan)


def _footprint_sigmas(course: Course, dimensions: DimensionsDerivative) -> Tensor:
    """Standard deviations (B, 5) along and across the car, of its heading, length and width, of the right size."""
    J = dimensions.J_hwl_code[:, 1:].flip(1).to(torch.float64)
    C = course.covariance
    size_variance = (J @ C[:, 6:, 6:] * J).sum(dim=2)
    variance = torch.cat([C.diagonal(dim1=1, dim2=2)[:, 0:6:2], size_variance], dim=1)
    return (variance * _SIGMA_FACTOR**2 + constant_like(_SIGMA_FLOORS, variance).square()).sqrt()


def _expected(motion: Tensor, sigma: Tensor, hwl: Tensor) -> tuple[Tensor, Tensor]:
    """Expected misfit (B,) of footprints whose errors are normal, and how much larger it is at the input.

    Motions of the output against the input and sigmas of the output (B, 5) are along and across the car, of heading,
    length and width.
    """
    _, width, length = hwl.clamp_min(0.1).unbind(1)
    # IoU falls by twice the shift over the side, by the change of a side over itself, and by the corners cut in a turn.
    turn = 0.5 * (length / width + width / length)
    per_length, per_width = 1 / length, 1 / width
    loss = torch.stack([2 * per_length, 2 * per_width, turn, per_length, per_width], dim=1)
    # E|x| of x ~ N(0, sigma^2) and of N(motion, sigma^2).
    at_output = sigma * math.sqrt(2 / math.pi)
    ratio = motion / sigma
    at_input = at_output * torch.exp(-0.5 * ratio.square()) + motion * torch.erf(ratio / math.sqrt(2))
    return (loss * at_output).sum(1), (loss * (at_input - at_output)).sum(1).clamp_min(0)


def _agreement(course: Course, agreement: Agreement) -> dict[str, Tensor]:
    """How well the images agree with the final state, and how many pixels say so."""
    photometric = course.stage.photometric
    support = torch.zeros_like(course.figures.cost) if photometric is None else photometric.pixel_set.support
    return {
        "mask_misfit_left": 1 - agreement.mask_iou_left,
        "mask_misfit_right": 1 - agreement.mask_iou_right,
        "log_photometric_error": (agreement.photometric_error_grey.clamp_min(0.1) / 10).log(),
        "unmatched_share": 1 - agreement.matched_share,
        "log_support": torch.log1p(support),
        "unsettled": course.unsettled.to(torch.float64),
    }


def _costs(course: Course) -> dict[str, Tensor]:
    """What the terms paid before and after, and whether photometry pulls against the others at the end."""
    names = course.stage.problem.term_names
    silhouettes = [name.startswith("silhouette") for name in names]
    photometric = [name == "photometric" for name in names]
    # (T, 2, B): before and after.
    costs = torch.stack([course.cost_before, course.cost_after]).permute(2, 0, 1)
    everything = costs.sum(dim=0)
    by_kind = (_total(costs, chosen) for chosen in (silhouettes, course.stage.is_prior_column, photometric))
    paid = torch.stack([*by_kind, everything])
    log_before, log_after = paid.clamp_min(_TINY).log().unbind(dim=1)
    decrease = log_before - log_after
    return {
        "log_silhouette_cost": log_after[0],
        "log_prior_cost": log_after[1],
        "silhouette_decrease": decrease[0],
        "photometric_decrease": decrease[2],
        "relative_decrease": decrease[3],
        "log_conflict": _conflict(course, photometric, everything[1]),
    }


def _total(costs: Tensor, chosen: list[bool]) -> Tensor:
    """Sum (2, B) of some rows of the costs (T, 2, B); the host knows which, so that no device has to look."""
    rows = [row for row, wanted in zip(costs, chosen, strict=True) if wanted]
    return torch.stack(rows).sum(dim=0) if rows else torch.zeros_like(costs[0])


def _profile(profile: DisparityProfile) -> dict[str, Tensor]:
    """How sharply the images know the disparity at the end, and how far they pulled the input."""
    before, after = profile.figures
    lowest_before, lowest_after = profile.lowest
    to_the_sides = torch.minimum(*(profile.cost_at(offset_px)[1] for offset_px in (-1.0, 1.0)))
    rise_after, fall_before = to_the_sides / lowest_after, profile.cost_at(0.0)[0] / lowest_before
    return {
        # A flat curve has no width: no offset of its range is any worse.
        "log_profile_sigma": after.sigma_px.minimum(profile.range_px).log(),
        "log_profile_offset": (after.offset_px.abs() + 0.05).log(),
        "log_profile_contrast": rise_after.log(),
        "profile_offset_before": before.offset_px.abs(),
        "log_profile_fall_before": fall_before.log(),
        "outside_basin": torch.where(after.offset_px.isnan(), after.offset_px, (~after.in_basin).to(torch.float64)),
    }


def _conflict(course: Course, photometric: list[bool], cost: Tensor) -> Tensor:
    """log(1 + 100 g_p^T H^-1 g_p / 2 / cost): what photometry alone asks for at the minimum of the sum.

    Path and next view of a track stand still: a view by itself does not know them.
    """
    if not any(photometric):
        return torch.zeros_like(cost)
    own = 6 + course.after.code.shape[1] + course.after.offset_px.shape[1]
    gradient, hessian = course.figures.gradient[..., :own], course.figures.hessian[..., :own, :own]
    gain = 0.5 * _mahalanobis(gradient[:, photometric.index(True)], hessian.sum(dim=1)).square()
    return torch.log1p(100 * gain / cost.clamp_min(_TINY))


def _mahalanobis(vector: Tensor, matrix: Tensor) -> Tensor:
    """sqrt(v^T M^-1 v) (B,) of vectors (B, n); NaN where M is not positive definite."""
    factor, regular = cholesky_of_regular(matrix)
    white = torch.linalg.solve_triangular(factor, vector[..., None], upper=False)[..., 0]
    return torch.where(regular, white.norm(dim=1), torch.nan)
