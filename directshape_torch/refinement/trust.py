"""How probable it is that a returned box is better than the detector's.

Where the car is there, its true box has the distribution that `fusion` gives from images and detector, and samples of
it say how often the returned box overlaps it more than the detector's. Whether the car is there at all, and not another
one or none, a logistic regression says from three columns of evidence. Derivation: docs/derivations/fusion.md.
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
"""A box is worse whose bird's-eye IoU is less than the input's by more than this."""

EVIDENCE_NAMES = ("log_halves_apart", "log_error_over_contrast", "log_detector_distance")
"""Columns of the evidence that a car is there.

`log_halves_apart`: by how much the photometric cost of upper, lower, left and right half of a car's pixels falls where
each takes its own best disparity, which pixels of one surface have in common; sum of the logarithms, plus 0.02.
`log_error_over_contrast`: photometric error over the mean deviation of grey levels within a neighbourhood of pixels.
`log_detector_distance`: the squared distance of the images' box from the detector's in seven standard deviations of
both, plus 3.
"""

# Beyond this many standard deviations of the cars of the fit nothing was learnt: the figure there holds.
_KNOWN_SIGMAS = 3.0
_NUM_SAMPLES = 256
_DEGREES_OF_FREEDOM = 4


class ImageNoise(NamedTuple):
    """What images are off by in `CAR_QUANTITIES`: `sqrt((factor * sigma)^2 + floor^2)`, sigma uncalibrated."""

    factors: tuple[float, ...]  # 7
    floors_m: tuple[float, ...]  # 7

    def covariance(self, uncalibrated: Tensor) -> Tensor:
        """The covariance (B, 7, 7) of images whose uncalibrated one is given."""
        factors, floors = (constant_like(x, uncalibrated) for x in self)
        return factors[:, None] * uncalibrated * factors + torch.diag(floors**2)


@dataclass(frozen=True)
class LogisticHead:
    """`P = sigmoid(bias + sum_i weights_i clamp((evidence_i - means_i) / scales_i))`."""

    means: tuple[float, ...]  # of `EVIDENCE_NAMES` over the cars of the fit
    scales: tuple[float, ...]  # likewise
    weights: tuple[float, ...]  # fitted
    bias: float

    def __call__(self, evidence: Tensor) -> Tensor:
        """Probabilities (B,) from the evidence (B, E); figures that do not exist count as the mean."""
        means, scales, weights = (constant_like(x, evidence) for x in (self.means, self.scales, self.weights))
        standard = ((evidence - means) / scales).clamp(-_KNOWN_SIGMAS, _KNOWN_SIGMAS)
        # A product and a sum rather than a matrix product, an exponential rather than PyTorch's sigmoid, which rounds
        # another way at the end of a batch: equal bits whatever its size.
        log_odds = self.bias + (torch.nan_to_num(standard, nan=0.0) * weights).sum(dim=1)
        return 1 / (1 + torch.exp(-log_odds))


@dataclass(frozen=True)
class TrustModel:
    """Everything that was measured on cars with truth, by scripts/calibrate_trust.py."""

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
        ValueError: it is that of another version.
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
    """The model that comes with the package; read at its first use."""
    return trust_model_of(json.loads(BUNDLED.read_text(encoding="utf-8")))


def probabilities(
    returned: Tensor,
    detector: Tensor,
    covariance: Tensor,
    hwl: Tensor,
    turned: Tensor,
) -> tuple[Tensor, Tensor]:
    """Whether the returned box overlaps the true one more than the detector's does, and less by at most 0.05.

    Two probabilities (B,). Overlaps are seen from above and fall with the errors by `exp(-loss)`.

    Args:
        returned: (B, 7) the returned box less the most probable one, `CAR_QUANTITIES`, metres.
        detector: (B, 7) the detector's box less the most probable one.
        covariance: (B, 7, 7) scales of Student's t of the true box about the most probable one.
        hwl: (B, 3) height, width and length of the car, metres.
        turned: (B,) angle from the viewing ray to the car's length, on the ground, radians.
    """
    half, info = torch.linalg.cholesky_ex(0.5 * (covariance + covariance.mT))
    truth = _student(covariance) @ half.mT  # (B, S, 7)
    at_returned, at_detector = (
        torch.exp(-_loss(truth - box[:, None], hwl.to(truth), turned.to(truth))) for box in (returned, detector)
    )
    # Equal boxes are as good as each other.
    better = 0.5 * (at_returned - at_detector).sign().mean(dim=1) + 0.5
    not_worse = (at_returned > at_detector - WORSE_BY).to(truth.dtype).mean(dim=1)
    known = (info == 0) & returned.isfinite().all(dim=1) & detector.isfinite().all(dim=1)
    return torch.where(known, better, torch.nan), torch.where(known, not_worse, torch.nan)


def _loss(error: Tensor, hwl: Tensor, turned: Tensor) -> Tensor:
    """What errors (B, S, 7) of a box cost of its overlap (B, S), to first order.

    IoU falls by twice the shift over the side, by the corners cut in a turn, and by the change of a side over itself.
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
    # The first of its points is a corner, where the distribution is infinite.
    uniform = engine.draw(_NUM_SAMPLES + 1, dtype=torch.float64)[1:]
    normal = math.sqrt(2) * torch.erfinv(2 * uniform[:, :7] - 1)
    # The sum of two exponential variables, twice, is chi-squared of 4 degrees of freedom.
    chi_squared = -2 * uniform[:, 7:].log().sum(dim=1, keepdim=True)
    samples = normal * (_DEGREES_OF_FREEDOM / chi_squared).sqrt()
    # Samples and their mirror images have the mean of the distribution.
    return torch.cat([samples, -samples]).to(device=device, dtype=dtype)
