"""This module computes how probable it is that a returned box is better than the detector's box.

If the car is there, its true box has the distribution that `fusion` gives from images and detector. Samples of this
distribution show how often the returned box overlaps the true box more than the detector's box does. A logistic
regression on three columns of evidence gives the probability that the car is there, and not another car or none. The
derivation is in docs/derivations/fusion.md.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from directshape_torch.files.atomic_files import write_text
from directshape_torch.numerics.tensors import constant_like, made_once
from directshape_torch.refinement.observability import HEADING_LEVER_M

SCHEMA = "directshape_torch.trust_model/2"
BUNDLED = Path(__file__).parents[1] / "assets" / "trust_model.json"
WORSE_BY = 0.05
"""A box is worse if its bird's-eye IoU is below the input's by more than this."""

EVIDENCE_NAMES = ("log_halves_apart", "log_error_over_contrast", "log_detector_distance")
"""These are the columns of the evidence that a car is there.

Each column is a logarithm. The argument of `log_halves_apart` is `DisparityProfile.halves_apart` plus 0.02: it is small
if all halves of a car's pixels have one best disparity, as pixels of one surface do. The argument of
`log_error_over_contrast` is the photometric error divided by the mean deviation of grey levels within a neighbourhood
of pixels. The argument of `log_detector_distance` is the squared distance between the images' box and the detector's
box in the standard deviations of both, over seven quantities, plus 3.
"""

# Evidence is clamped to this many standard deviations of the cars of the fit, because nothing was learnt beyond them.
_KNOWN_SIGMAS = 3.0
_NUM_SAMPLES = 256
_DEGREES_OF_FREEDOM = 4


class ImageNoise(NamedTuple):
    """The images' error in `CAR_QUANTITIES` is `sqrt((factor * sigma)^2 + floor^2)` with the uncalibrated sigma."""

    factors: tuple[float, ...]  # 7
    floors_m: tuple[float, ...]  # 7

    def covariance(self, uncalibrated: Tensor) -> Tensor:
        """Calibrated covariance (B, 7, 7) of the images from the uncalibrated one."""
        factors, floors = (constant_like(x, uncalibrated) for x in self)
        return factors[:, None] * uncalibrated * factors + torch.diag(floors**2)


@dataclass(frozen=True)
class LogisticHead:
    """It computes `P = sigmoid(bias + sum_i weights_i clamp((evidence_i - means_i) / scales_i))`."""

    means: tuple[float, ...]  # means of `EVIDENCE_NAMES` over the cars of the fit
    scales: tuple[float, ...]  # standard deviations of `EVIDENCE_NAMES` over the cars of the fit
    weights: tuple[float, ...]  # fitted
    bias: float

    def __call__(self, evidence: Tensor) -> Tensor:
        """Probabilities (B,) from the evidence (B, E); figures that do not exist count as the mean."""
        means, scales, weights = (constant_like(x, evidence) for x in (self.means, self.scales, self.weights))
        standard = ((evidence - means) / scales).clamp(-_KNOWN_SIGMAS, _KNOWN_SIGMAS)
        # A product with a sum replaces the matrix product, and an exponential replaces PyTorch's sigmoid, because both
        # round differently at the end of a batch. So the result is equal to the bit for every batch size.
        log_odds = self.bias + (torch.nan_to_num(standard, nan=0.0) * weights).sum(dim=1)
        return 1 / (1 + torch.exp(-log_odds))


@dataclass(frozen=True)
class TrustModel:
    """This is everything that scripts/calibrate_trust.py has measured on cars with ground truth."""

    car_is_there: LogisticHead
    image_noise: ImageNoise
    provenance: Mapping[str, Any]  # where the figures come from

    def save(self, path: Path | str) -> None:
        """Write the model as JSON."""
        content = {**asdict(self), "image_noise": self.image_noise._asdict()}
        write_text(path, json.dumps({"schema": SCHEMA, **content}, indent=1) + "\n")


def trust_model_of(content: Mapping[str, Any]) -> TrustModel:
    """The model that `TrustModel.save` has written.

    Raises:
        ValueError: the content comes from another version.
    """
    if content["schema"] != SCHEMA:
        raise ValueError(f"schema {content['schema']!r}, this version reads {SCHEMA!r}")
    head, noise = content["car_is_there"], content["image_noise"]
    means, scales, weights = (tuple(head[name]) for name in ("means", "scales", "weights"))
    factors, floors = (tuple(noise[name]) for name in ImageNoise._fields)
    is_there = LogisticHead(means, scales, weights, head["bias"])
    return TrustModel(is_there, ImageNoise(factors, floors), content["provenance"])


@cache
def bundled_trust_model() -> TrustModel:
    """The model that comes with the package; it is read at its first use."""
    return trust_model_of(json.loads(BUNDLED.read_text(encoding="utf-8")))


def probabilities(
    returned: Tensor,
    detector: Tensor,
    covariance: Tensor,
    hwl: Tensor,
    turned: Tensor,
) -> tuple[Tensor, Tensor]:
    """Compute the probabilities that a returned box is better than the detector's box, and that it is not worse.

    The first probability (B,) is that the returned box overlaps the true box more than the detector's box does, the
    second (B,) that its overlap is lower by at most 0.05. Overlaps are seen from above and fall with the errors by
    `exp(-loss)`.

    Args:
        returned: (B, 7) the returned box minus the most probable box, `CAR_QUANTITIES`, metres.
        detector: (B, 7) the detector's box minus the most probable box.
        covariance: (B, 7, 7) scales of Student's t of the true box around the most probable box.
        hwl: (B, 3) height, width and length of the car, metres.
        turned: (B,) angle from the viewing ray to the car's length, on the ground, radians.
    """
    half, info = torch.linalg.cholesky_ex(0.5 * (covariance + covariance.mT))
    truth = _student(covariance) @ half.mT  # (B, S, 7)
    at_returned, at_detector = (
        torch.exp(-_loss(truth - box[:, None], hwl.to(truth), turned.to(truth))) for box in (returned, detector)
    )
    # Equal boxes give a probability of 0.5.
    better = 0.5 * (at_returned - at_detector).sign().mean(dim=1) + 0.5
    not_worse = (at_returned > at_detector - WORSE_BY).to(truth.dtype).mean(dim=1)
    known = (info == 0) & returned.isfinite().all(dim=1) & detector.isfinite().all(dim=1)
    return torch.where(known, better, torch.nan), torch.where(known, not_worse, torch.nan)


def _loss(error: Tensor, hwl: Tensor, turned: Tensor) -> Tensor:
    """Loss of overlap (B, S) by errors (B, S, 7) of a box, to first order.

    The IoU falls by twice the shift divided by the side, by the corners that a turn cuts, and by the relative change of
    a side.
    """
    _, width, length = hwl.clamp_min(0.1)[:, :, None].unbind(dim=1)
    depth, sideways, _, heading, of_length, of_width, _ = error.unbind(dim=2)
    cos, sin = torch.cos(turned)[:, None], torch.sin(turned)[:, None]
    along, across = (cos * depth + sin * sideways).abs(), (cos * sideways - sin * depth).abs()
    turn = 0.5 * (length / width + width / length) * (heading / HEADING_LEVER_M).abs()
    return (2 * along + of_length.abs()) / length + (2 * across + of_width.abs()) / width + turn


@made_once
def _student(dtype: torch.dtype, device: torch.device) -> Tensor:
    """Samples (2 S, 7) of Student's t of 4 degrees of freedom and scale 1, evenly spread over its probability."""
    engine = torch.quasirandom.SobolEngine(9)  # type: ignore[no-untyped-call]
    # The first point of the Sobol sequence is a corner, where the distribution is infinite.
    uniform = engine.draw(_NUM_SAMPLES + 1, dtype=torch.float64)[1:]
    normal = math.sqrt(2) * torch.erfinv(2 * uniform[:, :7] - 1)
    # The sum of two exponential variables, twice, is chi-squared of 4 degrees of freedom.
    chi_squared = -2 * uniform[:, 7:].log().sum(dim=1, keepdim=True)
    samples = normal * (_DEGREES_OF_FREEDOM / chi_squared).sqrt()
    # Samples and their mirror images have the mean of the distribution.
    return torch.cat([samples, -samples]).to(device=device, dtype=dtype)
