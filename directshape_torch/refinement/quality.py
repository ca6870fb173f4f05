"""How well a car fits what the images show, what is known of how it came there, and whether to trust it.

The model of trust, logistic regressions on a few columns of the evidence and scales for the covariance, was fitted to
refined cars with truth by `scripts/calibrate_quality.py`; `assets/trust_model.json` says where it comes from.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import torch
from torch import Tensor

from directshape_torch.errors import DataFormatError
from directshape_torch.files.read_files import read_json
from directshape_torch.geometry.box3d import viewing_axes
from directshape_torch.numerics.records import CarRecord, Dense
from directshape_torch.numerics.tensors import constant_like

SCHEMA = "directshape_torch.trust_model/1"
BUNDLED = Path(__file__).parents[1] / "assets" / "trust_model.json"
# Beyond this many standard deviations of the cars of the fit nothing was learnt: the figure there holds.
_KNOWN_SIGMAS = 3.0

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


@dataclass(frozen=True)
class LogisticHead:
    """`P = sigmoid(bias + sum_i weights_i clamp((evidence_i - means_i) / scales_i))`."""

    columns: tuple[str, ...]  # names among `EVIDENCE_NAMES`
    means: tuple[float, ...]  # of these columns over the cars of the fit
    scales: tuple[float, ...]  # likewise
    weights: tuple[float, ...]  # fitted
    bias: float

    def __call__(self, evidence: Tensor) -> Tensor:
        """Probabilities (B,) from the evidence (B, E); figures that do not exist count as the mean."""
        columns = evidence.unbind(dim=1)
        chosen = torch.stack([columns[EVIDENCE_NAMES.index(name)] for name in self.columns], dim=1)
        means, scales, weights = (constant_like(x, chosen) for x in (self.means, self.scales, self.weights))
        standard = ((chosen - means) / scales).clamp(-_KNOWN_SIGMAS, _KNOWN_SIGMAS)
        # A product and a sum rather than a matrix product, an exponential rather than PyTorch's sigmoid, which rounds
        # another way at the end of a batch: equal bits whatever its size.
        log_odds = self.bias + (torch.nan_to_num(standard, nan=0.0) * weights).sum(dim=1)
        return 1 / (1 + torch.exp(-log_odds))


@dataclass(frozen=True)
class TrustModel:
    """Everything that was calibrated."""

    # Probability that the refined box overlaps the true one more than the input does, seen from above
    better: LogisticHead
    not_worse: LogisticHead  # that its overlap is at least the input's less 0.05
    # Of the uncalibrated standard deviations along and across the viewing ray in the ground plane, vertically, and
    # of the heading
    sigma_factors: tuple[float, float, float, float]
    # Added in quadrature to them, metres and radians: what shapes, masks and surfaces that are not as the model has
    # them cost, however many pixels there are
    sigma_floors: tuple[float, float, float, float]
    provenance: Mapping[str, Any]  # where the figures come from

    def calibrated_covariance(
        self,
        covariance_xyz_yaw: Tensor,  # (B, 4, 4)
        location: Tensor,  # (B, 3) of the cars, for their viewing rays
    ) -> Tensor:  # (B, 4, 4)
        """Covariance of (x, y, z, yaw) in true units: metres and radians."""
        # To (along the ray, across it, y, yaw).
        J = torch.nn.functional.pad(viewing_axes(location.to(covariance_xyz_yaw)), (0, 1, 0, 1))
        J[:, 3, 3] = 1
        factors, floors = (constant_like(x, covariance_xyz_yaw) for x in (self.sigma_factors, self.sigma_floors))
        in_view = factors[:, None] * (J @ covariance_xyz_yaw @ J.mT) * factors + torch.diag(floors**2)
        return J.mT @ in_view @ J

    def save(self, path: Path | str) -> None:
        """Write the model as JSON."""
        text = json.dumps({"schema": SCHEMA, **asdict(self)}, indent=1)
        Path(path).write_text(text + "\n", encoding="utf-8")


def load_trust_model(path: Path | str) -> TrustModel:
    """Read a file of `TrustModel.save`.

    Raises:
        DataFormatError: it is no such file, or of another schema version.
    """
    cure = "write it with scripts/calibrate_quality.py"
    content = read_json(path, cure)
    try:
        if content["schema"] != SCHEMA:
            raise DataFormatError(path, f"has schema {content['schema']!r}, this version reads {SCHEMA!r}")
        better, not_worse = (_head(content[name]) for name in ("better", "not_worse"))
        factors, floors = (tuple(map(float, content[name])) for name in ("sigma_factors", "sigma_floors"))
        unknown = {*better.columns, *not_worse.columns} - set(EVIDENCE_NAMES)
        if unknown or len(factors) != 4 or len(floors) != 4:
            raise DataFormatError(path, f"has unknown columns {sorted(unknown)}, or not four sigmas")
        return TrustModel(better, not_worse, factors, floors, content["provenance"])
    except (ValueError, KeyError, TypeError) as error:
        raise DataFormatError(path, f"is no model of trust ({error})", cure=cure) from error


@cache
def bundled_trust_model() -> TrustModel:
    """The model that comes with the package; read at its first use."""
    return load_trust_model(BUNDLED)


def _head(content: Mapping[str, Any]) -> LogisticHead:
    columns, numbers = tuple(content["columns"]), ("means", "scales", "weights")
    values = {name: tuple(map(float, content[name])) for name in numbers}
    if any(len(value) != len(columns) for value in values.values()):
        raise ValueError(f"{len(columns)} columns need as many {', '.join(numbers)}")
    return LogisticHead(columns, **values, bias=float(content["bias"]))
