"""How a `FitQuality` is made: masks and images against the shape at the end, and the probabilities of the evidence."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from directshape_torch.diagnosis.evidence import Agreement, Course, evidence_of
from directshape_torch.figures.quality import FitQuality
from directshape_torch.figures.trust_model import bundled_trust_model
from directshape_torch.rows import CarSums
from directshape_torch.terms.photometric import Photometric
from directshape_torch.terms.silhouette import MaskRows
from directshape_torch.terms.term import Part, Sight


@torch.no_grad()
def fit_quality(course: Course, masks: MaskRows, photometric: Photometric | None, at: Part | None) -> FitQuality:
    """Figures of B cars at the end of a refinement.

    Args:
        course: of the refinement.
        masks: the rays of both images.
        photometric: the term of the last stage, and what it says of the end; None without photometry.
        at: see there.
    """
    left, right = mask_ious(masks, course.seen)
    nan = torch.full_like(left, torch.nan)
    both = (nan, nan) if photometric is None or at is None else photometric_agreement(photometric, at)
    agreed = Agreement(left, right, *both)
    evidence = evidence_of(course, agreed)
    better, not_worse = _probabilities(course.term_names, evidence)
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
