"""How a `FitQuality` is made: masks and images against the shape at the end, and the probabilities of the evidence."""

from __future__ import annotations

import torch
from torch import Tensor

from directshape_torch.diagnosis.evidence import Agreement, Course, evidence_of
from directshape_torch.figures.quality import FitQuality
from directshape_torch.figures.trust_model import bundled_trust_model
from directshape_torch.problem import CarStage
from directshape_torch.rows import CarSums
from directshape_torch.terms.photometric import Photometric
from directshape_torch.terms.silhouette import MaskRows
from directshape_torch.terms.term import Part, Sight


@torch.no_grad()
def fit_quality(stage: CarStage, course: Course) -> FitQuality:
    """Figures of B cars at the end of a refinement, in its last stage."""
    agreed = _agreement(stage, course)
    evidence = evidence_of(stage, course, agreed)
    better, not_worse = _probabilities(stage, evidence)
    return FitQuality(*agreed, evidence, better, not_worse)


def _probabilities(stage: CarStage, evidence: Tensor) -> tuple[Tensor, Tensor]:
    """Of a better and of a not worse box, (B,) each; the model knows the terms of the method "direct" alone."""
    names = set(stage.problem.term_names)
    if not {"silhouette_left", "photometric"} <= names or "point_cloud" in names:
        unknown = torch.full_like(evidence[:, 0], torch.nan)
        return unknown, unknown
    model = bundled_trust_model()
    return model.better(evidence), model.not_worse(evidence)


def _agreement(stage: CarStage, course: Course) -> Agreement:
    left, right = mask_ious(stage.problem.masks, course.seen)
    nan = torch.full_like(left, torch.nan)
    term, at = stage.photometric, stage.photometric_part(course.figures)
    return Agreement(left, right, *((nan, nan) if term is None or at is None else photometric_agreement(term, at)))


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
