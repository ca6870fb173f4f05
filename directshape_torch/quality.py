"""How well a car fits what the images show: figures that say when not to trust a result."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from directshape_torch.car_rows import kept, placed
from directshape_torch.energy.car_problem import CarProblem
from directshape_torch.energy.car_state import CarState
from directshape_torch.energy.photometric_term import PhotometricTerm
from directshape_torch.energy.projected_state import ProjectedState
from directshape_torch.evidence import EVIDENCE_NAMES, Agreement, Course, evidence_of
from directshape_torch.observation.packing import PixelSamples
from directshape_torch.photometric_match import agreement
from directshape_torch.trust_model import bundled_trust_model


@dataclass(frozen=True)
class FitQuality:
    """Agreement of B refined cars with the images; NaN where there is nothing to compare.

    Attributes:
        mask_iou_left, mask_iou_right: (B,) overlap of the projected shape with the instance mask over the sampled,
            unoccluded pixels. Good fits stand above 0.9; below 0.8 mask or fit is wrong.
        photometric_error_grey: (B,) mean absolute difference between the images over the pixels that count, in grey
            levels of 0..255, after matching the brightness.
        matched_share: (B,) share of the photometric pixel set that could be compared at the end.
        evidence: (B, E) what is known of the refinement's course, columns `evidence.EVIDENCE_NAMES`.
        probability_better: (B,) calibrated probability that the refined box overlaps the true one more than the input
            does, seen from above; NaN for the methods "geometric" and "combined".
        probability_not_worse: (B,) that its overlap is at least the input's less 0.05. Figures of cars whose status is
            `not_trusted` speak of the refinement that was not returned.
    """

    mask_iou_left: Tensor
    mask_iou_right: Tensor
    photometric_error_grey: Tensor
    matched_share: Tensor
    evidence: Tensor
    probability_better: Tensor
    probability_not_worse: Tensor

    @classmethod
    def nothing(cls, like: Tensor, count: int) -> FitQuality:
        """No figures for `count` cars."""
        nan = torch.full((count,), torch.nan, dtype=torch.float64, device=like.device)
        return cls(nan, nan, nan, nan, nan[:, None].expand(-1, len(EVIDENCE_NAMES)), nan, nan)

    def spread(self, rows: Tensor, count: int) -> FitQuality:
        """The figures of some cars placed among `count` cars."""
        return FitQuality(*(placed(getattr(self, f.name), rows, count) for f in fields(self)))

    def where(self, condition: Tensor) -> FitQuality:
        """The figures where the condition (B,) holds, NaN elsewhere."""
        return FitQuality(*(kept(getattr(self, f.name), condition) for f in fields(self)))


@torch.no_grad()
def fit_quality(problem: CarProblem, course: Course) -> FitQuality:
    """Figures of B cars at the end of a refinement whose last stage is the problem's present one."""
    agreed = _agreement(problem, course.after)
    evidence = evidence_of(problem, course, agreed)
    better, not_worse = _probabilities(problem, evidence)
    return FitQuality(*agreed, evidence, better, not_worse)


def _probabilities(problem: CarProblem, evidence: Tensor) -> tuple[Tensor, Tensor]:
    """Of a better and of a not worse box, (B,) each; the model knows the terms of the method "direct" alone."""
    names = {term.name for term in problem.terms}
    if not {"silhouette_left", "photometric"} <= names or "point_cloud" in names:
        unknown = torch.full_like(evidence[:, 0], torch.nan)
        return unknown, unknown
    model = bundled_trust_model()
    return model.better(evidence), model.not_worse(evidence)


def _agreement(problem: CarProblem, state: CarState) -> Agreement:
    projected = problem.project(state)
    left, right = _mask_ious(projected, problem.left, problem.right)
    nan = torch.full_like(left, torch.nan)
    for term in problem.terms:
        if isinstance(term, PhotometricTerm):
            error, share = agreement(term, projected)
            return Agreement(left, right, error, share)
    return Agreement(left, right, nan, nan)


def _mask_ious(projected: ProjectedState, left: PixelSamples, right: PixelSamples) -> Tensor:
    """Overlap (2, B) of shape and mask over the pixels of the left and the right image."""
    views, count = (projected.left, projected.right), len(projected.state.code)
    covered = (torch.cat([view.closest_sdf for view in views]) < 0) & torch.cat(
        [view.march.crosses_bounds for view in views]
    )
    masked = torch.cat([left.foreground, right.foreground]) > 0.5
    car = torch.cat([left.object_index, right.object_index + count])
    nothing = torch.zeros(2 * count, dtype=torch.long, device=car.device)
    # Of whole numbers the sum is the same in whatever order a device adds them.
    both, either = (nothing.scatter_add(0, car, pixels.long()) for pixels in (covered & masked, covered | masked))
    overlap = both.to(torch.float64) / either
    return torch.where(either > 0, overlap, torch.nan).view(2, count)
