"""Detections made from labels by a seeded noise model, and the model whose average precision is a wanted one.

Errors of each box, all normally distributed: depth along the viewing ray (a share of the distance), sideways, heading,
height above the ground, and dimensions. Scores fall with the distance and are noisy, as those of detectors are. The
image box is that of the label: the detectors meant here build on good 2D boxes. There are misses, but no false alarms.

Every label draws the same random numbers whatever the model and whichever other frames there are, so that a larger
model moves each box farther in the same direction, and average precision falls almost steadily with it. `tuned_model`
relies on that: it finds by bisection the model whose AP is the one asked for.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from directshape_torch.evaluation.kitti_ap import evaluate_kitti
from directshape_torch.files.atomic_files import write_text
from directshape_torch.files.text_files import Line
from directshape_torch.io.kitti_labels import KittiObject, parse_object

# One unit of `ground_scale`: a stereo detector's errors.
DEPTH_SHARE, LATERAL_M, YAW_DEG = 0.025, 0.12, 5.0
# One unit of `vertical_scale`.
VERTICAL_M, HEIGHT_SHARE = 0.05, 0.03
FOOTPRINT_SHARE = 0.03
MINIMUM_HEIGHT_PX = 25.0
_MAXIMUM_DEPTH_SHARE = 0.5

Labels = Mapping[str, Sequence[KittiObject]]


@dataclass(frozen=True)
class NoiseModel:
    """How wrong a simulated detector is.

    Attributes:
        ground_scale: of the errors in the ground plane (depth, sideways, heading).
        vertical_scale: of those in height.
        found_share: of the labels that it finds.
        seed: of the random numbers.
    """

    ground_scale: float = 1.0
    vertical_scale: float = 1.0
    found_share: float = 1.0
    seed: int = 0


@dataclass(frozen=True)
class WantedAp:
    """Average precisions in percent, moderate, over 11 recall points as in the paper's table."""

    bev_50: float
    bev_70: float
    box_50: float
    box_70: float


def simulated_lines(labels: Labels, model: NoiseModel) -> dict[str, list[str]]:
    """Result lines by frame for the cars at least 25 px high, best score first."""
    return {frame_id: _frame_lines(frame_id, objects, model) for frame_id, objects in labels.items()}


def _frame_lines(frame_id: str, objects: Sequence[KittiObject], model: NoiseModel) -> list[str]:
    generator = np.random.default_rng([model.seed, *frame_id.encode()])
    scored = []
    for label in objects:
        if label.type != "Car" or not label.has_box_3d:
            continue
        noise, luck = generator.standard_normal(8), generator.random()
        if luck < model.found_share and label.box_2d[3] - label.box_2d[1] >= MINIMUM_HEIGHT_PX:
            scored.append(_result_line(label, noise.tolist(), model))
    return [line for _, line in sorted(scored, reverse=True)]


def _result_line(label: KittiObject, noise: Sequence[float], model: NoiseModel) -> tuple[float, str]:
    depth, lateral, yaw, vertical, tall, wide, long, luck = noise
    x, y, z = label.location_ref
    share = model.ground_scale * DEPTH_SHARE * depth
    factor = 1 + min(max(share, -_MAXIMUM_DEPTH_SHARE), _MAXIMUM_DEPTH_SHARE)
    distance = math.hypot(x, z)
    sideways = model.ground_scale * LATERAL_M * lateral
    x, z = factor * x + sideways * z / distance, factor * z - sideways * x / distance
    y += model.vertical_scale * VERTICAL_M * vertical
    height, width, length = label.hwl
    height *= 1 + model.vertical_scale * HEIGHT_SHARE * tall
    width, length = width * (1 + FOOTPRINT_SHARE * wide), length * (1 + FOOTPRINT_SHARE * long)
    rotation_y = _wrapped(label.rotation_y + math.radians(model.ground_scale * YAW_DEG * yaw))
    score = min(max(0.9 - distance / 100 + 0.15 * luck, 0.01), 0.99)
    numbers = [*label.box_2d, max(height, 0.5), width, length, x, y, max(z, 1.0), rotation_y]
    alpha = _wrapped(rotation_y - math.atan2(x, z))
    return score, f"Car -1 -1 {alpha:.4f} " + " ".join(f"{n:.4f}" for n in numbers) + f" {score:.4f}"


def _wrapped(angle: float) -> float:
    return math.remainder(angle, math.tau)


def average_precisions(labels: Labels, model: NoiseModel) -> WantedAp:
    """What a model reaches."""
    results = {
        frame_id: [parse_object("simulated", Line(n, text, text)) for n, text in enumerate(lines, start=1)]
        for frame_id, lines in simulated_lines(labels, model).items()
    }
    scores = evaluate_kitti(labels, results)
    bev_50, bev_70, box_50, box_70 = (
        scores.score(metric, iou, "moderate").ap_r11 for metric in ("bev", "3d") for iou in (0.5, 0.7)
    )
    return WantedAp(bev_50, bev_70, box_50, box_70)


def miss(reached: WantedAp, wanted: WantedAp) -> float:
    """Root mean square difference of the four figures, percentage points."""
    pairs = zip(asdict(reached).values(), asdict(wanted).values(), strict=True)
    return math.sqrt(sum((a - b) ** 2 for a, b in pairs) / 4)


def tuned_model(
    labels: Labels, wanted: WantedAp, seeds: Sequence[int] = (0, 1, 2, 3), rounds: int = 3
) -> tuple[NoiseModel, WantedAp]:
    """The model that comes closest to the wanted figures, and what it reaches.

    In turn each knob is set by bisection to the figure that depends on it most: errors on the ground to AP_BEV at 0.7,
    the found share to AP_BEV at 0.5, vertical errors to AP_3D at 0.5. AP_3D at 0.7 is left to follow. The three depend
    on one another, so this goes round a few times, for a few seeds, and the closest of all is kept.
    """
    best: tuple[float, NoiseModel, WantedAp] | None = None
    for seed in seeds:
        model = NoiseModel(2.0, 1.0, 0.8, seed)
        for _ in range(rounds):
            for knob, figure, low, high, rising in _KNOBS:
                value = bisect(_figure_of(labels, model, knob, figure), getattr(wanted, figure), low, high, rising)
                model = _with_knob(model, knob, value)
            reached = average_precisions(labels, model)
            if best is None or miss(reached, wanted) < best[0]:
                best = miss(reached, wanted), model, reached
    assert best is not None, "no seeds"
    return best[1], best[2]


_KNOBS = (
    ("ground_scale", "bev_70", 0.0, 12.0, False),
    ("found_share", "bev_50", 0.05, 1.0, True),
    ("vertical_scale", "box_50", 0.0, 12.0, False),
)


def _with_knob(model: NoiseModel, knob: str, value: float) -> NoiseModel:
    return NoiseModel(**{**asdict(model), knob: value})


def _figure_of(labels: Labels, model: NoiseModel, knob: str, figure: str) -> Callable[[float], float]:
    return lambda value: float(getattr(average_precisions(labels, _with_knob(model, knob, value)), figure))


def bisect(
    function: Callable[[float], float], wanted: float, low: float, high: float, rising: bool, steps: int = 9
) -> float:
    """Where an almost steady function comes closest to a value, among the points that bisection looks at.

    Example:
        >>> round(bisect(lambda x: x * x, 2.0, 0.0, 4.0, rising=True, steps=20), 3)
        1.414
    """
    closest, distance = low, math.inf
    for _ in range(steps):
        middle = 0.5 * (low + high)
        value = function(middle)
        if abs(value - wanted) < distance:
            closest, distance = middle, abs(value - wanted)
        if (value < wanted) == rising:
            low = middle
        else:
            high = middle
    return closest


def write_detections(folder: Path, labels: Labels, model: NoiseModel) -> Path:
    """Write result files into `folder/data`; returns the folder. Files that hold the same text stay as they are."""
    for frame_id, lines in simulated_lines(labels, model).items():
        path = folder / "data" / f"{frame_id}.txt"
        text = "".join(f"{line}\n" for line in lines)
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            write_text(path, text)
    return folder
