"""This module measures how well a car fits the images, and computes the evidence for `refinement.trust`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import torch
from torch import Tensor

from directshape_torch.numerics.records import CarRecord, Dense
from directshape_torch.refinement.problem import CarStage
from directshape_torch.refinement.trust import bundled_trust_model
from directshape_torch.rows import CarSums
from directshape_torch.scene.masks import MASK_THRESHOLD
from directshape_torch.terms.photometric import Photometric, Surface
from directshape_torch.terms.silhouette import MaskRows
from directshape_torch.terms.term import Figures, Part, Prepared

# The front of a car is called unknown below this probability.
_FRONT_KNOWN_FROM = 0.8
# Images that show only noise have this contrast, in grey levels.
_LEAST_CONTRAST = 0.3


@dataclass(frozen=True)
class FitQuality(CarRecord):
    """This is the agreement of B refined cars with the images. It is NaN where there is nothing to compare.

    Attributes:
        mask_iou_left, mask_iou_right: (B,) IoU of the projected shape with the instance mask over the sampled,
            unoccluded pixels. Good fits have more than 0.9. Below 0.8 the mask or the fit is wrong.
        photometric_error_grey: (B,) mean absolute difference between the images over the pixels that count, in grey
            levels of 0..255, after matching the brightness.
        matched_share: (B,) share of the photometric pixel set that could be compared at the end.
        evidence: (B, E) evidence that the car is there at all, columns `trust.EVIDENCE_NAMES`.
        probability_better: (B,) calibrated probability that the returned box overlaps the true one more than the
            input does, seen from above; NaN unless silhouettes and photometry are fitted, without a point cloud.
        probability_not_worse: (B,) calibrated probability that the overlap of the returned box is at least the input's
            overlap minus 0.05. For cars with status `not_trusted` or `no_car` all figures belong to the refinement that
            was not returned.
        probability_heading: (B,) calibrated probability that the front of the car is where the result has it, and not
            at the opposite end. It is 0.5 where the images cannot tell, below it where the likelier
            sense was refused, and NaN where only one sense was tried.
    """

    mask_iou_left: Annotated[Tensor, Dense("B")]
    mask_iou_right: Annotated[Tensor, Dense("B")]
    photometric_error_grey: Annotated[Tensor, Dense("B")]
    matched_share: Annotated[Tensor, Dense("B")]
    evidence: Annotated[Tensor, Dense("B", "E")]
    probability_better: Annotated[Tensor, Dense("B")]
    probability_not_worse: Annotated[Tensor, Dense("B")]
    probability_heading: Annotated[Tensor, Dense("B")]


def is_front_known(probability_heading: float) -> bool:
    """Whether the front of a car is called known; a sense that nobody questioned (NaN) is."""
    return not probability_heading < _FRONT_KNOWN_FROM


@torch.no_grad()
def fit_quality(
    stage: CarStage,
    figures: Figures,
    prepared: Prepared,
    halves_apart: Tensor,
    distance_in_sigmas: Tensor,
    chances: tuple[Tensor, Tensor],
) -> FitQuality:
    """Figures of B cars at the end of a refinement.

    Args:
        stage: the last stage of the refinement.
        figures: the energy at the final states.
        prepared: the final states, with what their rays hit.
        halves_apart: (B,) see `DisparityProfile.halves_apart`.
        distance_in_sigmas: (B,) distance from the detector's box, see `DetectorComparison`.
        chances: two probabilities (B,) of a better box and of a box that is not worse, if the car is there.
    """
    left, right = mask_ious(stage.problem.masks, prepared)
    error, share, contrast = [torch.full_like(left, torch.nan)] * 3
    photometric, at = stage.photometric, stage.photometric_part(figures)
    if photometric is not None and at is not None:
        error, share, contrast = photometric_agreement(photometric, at)
    misfit = error / contrast.clamp_min(_LEAST_CONTRAST)
    evidence = torch.stack(
        [(halves_apart + 0.02).log(), misfit.clamp_min(0.01).log(), evidence_of_distance(distance_in_sigmas)], dim=1
    ).to(torch.float64)
    is_there = bundled_trust_model().car_is_there(evidence)
    if not is_judged(stage.problem.term_names):
        is_there = torch.full_like(is_there, torch.nan)
    better, not_worse = (is_there * chance for chance in chances)
    return FitQuality(left, right, error, share, evidence, better, not_worse, torch.full_like(left, torch.nan))


def evidence_of_distance(distance_in_sigmas: Tensor) -> Tensor:
    """The column `log_detector_distance` (B,) of the evidence."""
    return (distance_in_sigmas**2 + 3).log()


def is_judged(term_names: tuple[str, ...]) -> bool:
    """Whether there are probabilities: their figures were measured with silhouettes and photometry, without points."""
    return {"silhouette_left", "photometric"} <= set(term_names) and "point_cloud" not in term_names


def mask_ious(masks: MaskRows, prepared: Prepared) -> Tensor:
    """IoU (2, B) of shape and mask over the pixels of the left and the right image."""
    distance = prepared.field.sdf(prepared.closest.points_obj, masks.rays.owner)
    counts = masks.filled.to(torch.float64)
    covered, masked = prepared.closest.crosses & (distance < 0), masks.foreground > MASK_THRESHOLD
    both, either = ((x * counts).sum(dim=1) for x in (covered & masked, covered | masked))
    num_cars = len(masks.blocks.counts)
    sums = CarSums.of(masks.rays.owner + num_cars * masks.side, 2 * num_cars)
    overlap, union = sums.sum(torch.stack([both, either], dim=1)).unbind(dim=1)
    return torch.where(union > 0, overlap / union, torch.nan).view(2, num_cars)


def photometric_agreement(term: Photometric, at: Part[Surface]) -> tuple[Tensor, Tensor, Tensor]:
    """Measure the mean absolute residual (B,) of the usable pixels, their share (B,) of the set, and their contrast.

    Residual and contrast are in grey levels. The contrast (B,) is the mean absolute deviation of grey levels from the
    mean of their neighbourhood.
    """
    fixed, usable = term.pixel_set, at.anchor.usable
    in_set = usable & (fixed.rows.pixel_weight > 0)
    neighbours = fixed.rows.neighbour_weight.movedim(0, -1)
    weight, grey = in_set[..., None] * neighbours, fixed.rows.intensity_left.movedim(0, -1)
    mean = (neighbours * grey).sum(dim=-1, keepdim=True) / neighbours.sum(dim=-1, keepdim=True).clamp_min(1e-6)
    deviations = (weight * x.abs() for x in (at.residual, grey - mean))
    per_block = [*(x.sum(dim=(1, 2)) for x in deviations), weight.sum(dim=(1, 2)), in_set.sum(dim=1)]
    table = torch.stack([x.to(torch.float64) for x in per_block], dim=1)
    error, deviation, total, compared = CarSums.of(fixed.blocks.owner, len(term.cars)).sum(table).unbind(dim=1)
    share = torch.where(fixed.support > 0, compared / fixed.support.clamp_min(1), torch.nan)
    error, contrast = (torch.where(total > 0, x / total.clamp_min(1), torch.nan) for x in (error, deviation))
    return error, share, contrast
