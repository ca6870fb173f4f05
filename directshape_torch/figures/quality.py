"""How well a car fits what the images show, what is known of how it came there, and whether to trust it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import torch
from torch import Tensor

from directshape_torch.numerics.records import CarRecord, Dense

EVIDENCE_NAMES = (
    "log_depth",
    "log_sigma_depth",
    "log_sigma_side",
    "log_sigma_yaw",
    "log_expected_misfit",
    "log_expected_gain",
    "moved_depth",
    "turned",
    "log_moved_sigmas",
    "length_change",
    "mask_misfit_left",
    "mask_misfit_right",
    "log_photometric_error",
    "unmatched_share",
    "log_support",
    "log_silhouette_cost",
    "log_prior_cost",
    "silhouette_decrease",
    "photometric_decrease",
    "relative_decrease",
    "log_conflict",
    "code_size",
    "unsettled",
    "log_profile_sigma",
    "log_profile_offset",
    "log_profile_contrast",
    "profile_offset_before",
    "log_profile_fall_before",
    "outside_basin",
    "log_detector_sigma",
)
"""Columns of the evidence; `docs/results.md` says which of them the bundled model reads.

`log_depth` metres over 20; `log_sigma_*` of the uncalibrated covariance, along and across the viewing ray in the ground
plane (metres) and of the heading (radians); `log_expected_misfit` the share of the box, seen from above, that these
sigmas let one expect to be wrong, `log_expected_gain` by how much more it would be at the input; `moved_depth` motion
along the viewing ray, metres; `turned` radians; `log_moved_sigmas` Mahalanobis length of the motion; `length_change`
metres; `mask_misfit_*` one minus the overlap with the mask; `*_decrease` log of cost before over cost after;
`log_conflict` share of the cost that photometry alone would still gain by a step; `code_size` root mean square;
`unsettled` 1 where the iterations ran out. Of the disparity profile at the end: `log_profile_sigma` and
`log_profile_offset` of its minimum, pixels, `log_profile_contrast`, how much more a pixel of disparity to the better
side costs, `outside_basin` 1 where a ridge lies between the state and the minimum. Of the one at the input:
`profile_offset_before` of its minimum, pixels, and `log_profile_fall_before`, cost there over that at the minimum.
`log_detector_sigma` of what the detector's depth is known to be off by, as a share of the depth.
"""


@dataclass(frozen=True)
class FitQuality(CarRecord):
    """Agreement of B refined cars with the images; NaN where there is nothing to compare.

    Attributes:
        mask_iou_left, mask_iou_right: (B,) overlap of the projected shape with the instance mask over the sampled,
            unoccluded pixels. Good fits stand above 0.9; below 0.8 mask or fit is wrong.
        photometric_error_grey: (B,) mean absolute difference between the images over the pixels that count, in grey
            levels of 0..255, after matching the brightness.
        matched_share: (B,) share of the photometric pixel set that could be compared at the end.
        evidence: (B, E) what is known of the refinement's course, columns `EVIDENCE_NAMES`.
        probability_better: (B,) calibrated probability that the refined box overlaps the true one more than the input
            does, seen from above; NaN for all methods but "direct".
        probability_not_worse: (B,) that its overlap is at least the input's less 0.05. Figures of cars whose status is
            `not_trusted` speak of the refinement that was not returned.
    """

    mask_iou_left: Annotated[Tensor, Dense("B")]
    mask_iou_right: Annotated[Tensor, Dense("B")]
    photometric_error_grey: Annotated[Tensor, Dense("B")]
    matched_share: Annotated[Tensor, Dense("B")]
    evidence: Annotated[Tensor, Dense("B", "E")]
    probability_better: Annotated[Tensor, Dense("B")]
    probability_not_worse: Annotated[Tensor, Dense("B")]

    @classmethod
    def nothing(cls, like: Tensor, count: int) -> FitQuality:
        """No figures for `count` cars."""
        nan = torch.full((count,), torch.nan, dtype=torch.float64, device=like.device)
        return cls(nan, nan, nan, nan, nan[:, None].expand(-1, len(EVIDENCE_NAMES)), nan, nan)
