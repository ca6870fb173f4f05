"""How well a car fits what the images show, what is known of how it came there, and whether to trust it.

The model of trust, logistic regressions on a few columns of the evidence and scales for the covariance, was fitted to
refined cars with truth by `scripts/calibrate_quality.py`; `assets/trust_model.json` says where it comes from.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import torch
from torch import Tensor

from directshape_torch.files.atomic_files import write_text
from directshape_torch.geometry import se3
from directshape_torch.geometry.box3d import rotation_y_from_pose, viewing_axes, wrap_angle
from directshape_torch.masks import MASK_THRESHOLD
from directshape_torch.numerics.records import CarRecord, Dense
from directshape_torch.numerics.tensors import constant_like
from directshape_torch.refinement.disparity_profile import DisparityProfile
from directshape_torch.refinement.problem import CarProblem, CarStage
from directshape_torch.rows import CarSums
from directshape_torch.shape.shape_prior import DimensionsDerivative
from directshape_torch.terms.cars import CarBatch, CarState
from directshape_torch.terms.photometric import Photometric
from directshape_torch.terms.priors import detector_pose_sigma
from directshape_torch.terms.silhouette import MaskRows
from directshape_torch.terms.term import Figures, Part, Sight

SCHEMA = "directshape_torch.trust_model/1"
BUNDLED = Path(__file__).parents[1] / "assets" / "trust_model.json"
# Beyond this many standard deviations of the cars of the fit nothing was learnt: the figure there holds.
_KNOWN_SIGMAS = 3.0
_TINY = 1e-9
# Round figures of the calibration: what the sigmas are short of, and the least errors of length, width and heading.
_SIGMA_FACTOR = 2.0
_SIGMA_FLOORS = (0.05, 0.04, 0.01, 0.1, 0.03)

EVIDENCE_NAMES = (
    "relative_decrease",
    "turned",
    "log_expected_gain",
    "log_sigma_yaw",
    "log_detector_sigma",
    "mask_misfit_left",
    "log_profile_contrast",
    "log_profile_fall_before",
)
"""Columns of the evidence.

`relative_decrease` log of cost before over cost after; `turned` radians; `log_expected_gain` by how much less of the
box, seen from above, the uncalibrated covariance lets one expect to be wrong than at the input; `log_sigma_yaw` of that
covariance, radians; `log_detector_sigma` of what the detector's depth is known to be off by, as a share of the depth;
`mask_misfit_left` one minus the overlap with the mask. Of the disparity profiles: `log_profile_contrast`, how much more
a pixel of disparity to the better side costs at the end, and `log_profile_fall_before`, cost at the input over that at
the minimum.
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
        probability_not_worse: (B,) that its overlap is at least the input's less 0.05. Both speak of the images' box,
            also where it was brought together with the detector's, and figures of cars whose status is `not_trusted` of
            the refinement that was not returned.
    """

    mask_iou_left: Annotated[Tensor, Dense("B")]
    mask_iou_right: Annotated[Tensor, Dense("B")]
    photometric_error_grey: Annotated[Tensor, Dense("B")]
    matched_share: Annotated[Tensor, Dense("B")]
    evidence: Annotated[Tensor, Dense("B", "E")]
    probability_better: Annotated[Tensor, Dense("B")]
    probability_not_worse: Annotated[Tensor, Dense("B")]


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
        write_text(path, json.dumps({"schema": SCHEMA, **asdict(self)}, indent=1) + "\n")


def trust_model_of(content: Mapping[str, Any]) -> TrustModel:
    """The model that `TrustModel.save` has written.

    Raises:
        ValueError: it is that of another version.
    """
    if content["schema"] != SCHEMA:
        raise ValueError(f"schema {content['schema']!r}, this version reads {SCHEMA!r}")
    heads = []
    for head in (content["better"], content["not_worse"]):
        columns, means, scales, weights = (tuple(head[name]) for name in ("columns", "means", "scales", "weights"))
        heads.append(LogisticHead(columns, means, scales, weights, head["bias"]))
    factors, floors = (tuple(content[name]) for name in ("sigma_factors", "sigma_floors"))
    better, not_worse = heads
    return TrustModel(better, not_worse, factors, floors, content["provenance"])


@cache
def bundled_trust_model() -> TrustModel:
    """The model that comes with the package; read at its first use."""
    return trust_model_of(json.loads(BUNDLED.read_text(encoding="utf-8")))


@torch.no_grad()
def fit_quality(stage: CarStage, figures: Figures, seen: Sight, evidence: Mapping[str, Tensor]) -> FitQuality:
    """Figures of B cars at the end of a refinement.

    Args:
        stage: the last one.
        figures: of the energy at the final states.
        seen: what the rays see there.
        evidence: columns (B,) of `EVIDENCE_NAMES`, but that of the masks.
    """
    left, right = mask_ious(stage.problem.masks, seen)
    nan = torch.full_like(left, torch.nan)
    photometric, at = stage.photometric, stage.photometric_part(figures)
    both = (nan, nan) if photometric is None or at is None else photometric_agreement(photometric, at)
    columns = {**evidence, "mask_misfit_left": 1 - left}
    table = torch.stack([columns[name].to(torch.float64) for name in EVIDENCE_NAMES], dim=1)
    return FitQuality(left, right, *both, table, *_probabilities(stage.problem.term_names, table))


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
    covered, masked = seen.closest.crosses & (distance < 0), masks.foreground > MASK_THRESHOLD
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


def evidence_of_motion(
    problem: CarProblem,
    cars: CarBatch,
    before: CarState,
    after: CarState,
    covariance: Tensor,  # (B, D, D) in the tangent of `retract`, uncalibrated
    covariance_xyz_yaw: Tensor,  # (B, 4, 4), uncalibrated
) -> dict[str, Tensor]:
    """How far the box was turned, and what the motion is worth in shares of itself."""
    T_before, T_after = (se3.inverse(state.T_obj_cam.to(torch.float64)) for state in (before, after))
    dimensions = problem.prior.dimensions_and_derivative(after.code)
    hwl = dimensions.hwl.to(torch.float64)
    turned = wrap_angle(rotation_y_from_pose(T_after) - rotation_y_from_pose(T_before))
    shift_cam = T_after[:, :3, 3] - T_before[:, :3, 3]
    shift_obj = (shift_cam[:, None] @ T_after[:, :3, :3])[:, 0]
    change_wl = (hwl - cars.detector_hwl)[:, 1:]
    motion = torch.cat([shift_obj[:, 0::2], turned[:, None], change_wl.flip(1)], dim=1)
    gain = _expected_gain(motion, _footprint_sigmas(covariance, dimensions), hwl)
    # A share of the depth; NaN where nobody knows it.
    sigma, depth = detector_pose_sigma(problem.config.priors, cars)[:, 0], T_before[:, 2, 3]
    is_known = sigma.isfinite() & (sigma > 0)
    return {
        "log_sigma_yaw": 0.5 * covariance_xyz_yaw[:, 3, 3].clamp_min(_TINY**2).log(),
        "log_expected_gain": (gain + 0.005).log(),
        "turned": turned.abs(),
        "log_detector_sigma": torch.where(is_known, (sigma.to(depth) / depth.clamp_min(1.0)).log(), torch.nan),
    }


def _footprint_sigmas(covariance: Tensor, dimensions: DimensionsDerivative) -> Tensor:
    """Standard deviations (B, 5) along and across the car, of its heading, length and width, of the right size."""
    J = dimensions.J_hwl_code[:, 1:].flip(1).to(torch.float64)
    size_variance = (J @ covariance[:, 6:, 6:] * J).sum(dim=2)
    variance = torch.cat([covariance.diagonal(dim1=1, dim2=2)[:, 0:6:2], size_variance], dim=1)
    return (variance * _SIGMA_FACTOR**2 + constant_like(_SIGMA_FLOORS, variance).square()).sqrt()


def _expected_gain(motion: Tensor, sigma: Tensor, hwl: Tensor) -> Tensor:
    """By how much (B,) the expected misfit of footprints whose errors are normal is larger at the input.

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
    return (loss * (at_input - at_output)).sum(1).clamp_min(0)


def evidence_of_costs(
    cost_before: Tensor,  # (B, T) of the input, at the final stage
    cost_after: Tensor,  # (B, T) of the final state
    profile: DisparityProfile,
) -> dict[str, Tensor]:
    """What the energy fell by, how sharply the images know the disparity, and how far they pulled the input."""
    log_before, log_after = (cost.sum(dim=1).clamp_min(_TINY).log() for cost in (cost_before, cost_after))
    lowest_before, lowest_after = profile.lowest
    to_the_sides = torch.minimum(*(profile.cost_at(offset_px)[1] for offset_px in (-1.0, 1.0)))
    return {
        "relative_decrease": log_before - log_after,
        "log_profile_contrast": (to_the_sides / lowest_after).log(),
        "log_profile_fall_before": (profile.cost_at(0.0)[0] / lowest_before).log(),
    }
