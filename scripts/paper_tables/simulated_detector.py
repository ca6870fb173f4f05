"""Detections made from labels by seeded noise of a chosen size.

Errors of each box, all normally distributed: depth along the viewing ray (a share of the distance), sideways, heading,
height above the ground, and dimensions. Scores fall with the distance and are noisy, as those of detectors are. The
image box is that of the label. There are neither misses nor false alarms. Every label draws the same random numbers
whatever the size and whichever other frames there are, so larger noise moves each box farther in the same direction.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from directshape_torch.files.atomic_files import write_text
from directshape_torch.io.kitti_labels import KittiObject

# A stereo detector's errors on the ground, which `scale` multiplies.
DEPTH_SHARE, LATERAL_M, YAW_DEG = 0.025, 0.12, 5.0
VERTICAL_M, HEIGHT_SHARE = 0.05, 0.03
FOOTPRINT_SHARE = 0.03
MINIMUM_HEIGHT_PX = 25.0
_MAXIMUM_DEPTH_SHARE = 0.5

Labels = Mapping[str, Sequence[KittiObject]]


def simulated_lines(labels: Labels, scale: float, seed: int = 0) -> dict[str, list[str]]:
    """Result lines by frame for the cars at least 25 px high, best score first.

    Args:
        labels: by frame.
        scale: of the errors in the ground plane (depth, sideways, heading); 1 is a stereo detector.
        seed: of the random numbers.
    """
    return {frame_id: _frame_lines(frame_id, objects, scale, seed) for frame_id, objects in labels.items()}


def _frame_lines(frame_id: str, objects: Sequence[KittiObject], scale: float, seed: int) -> list[str]:
    generator = np.random.default_rng([seed, *frame_id.encode()])
    scored = []
    for label in objects:
        if label.type != "Car" or not label.has_box_3d:
            continue
        noise, _ = generator.standard_normal(8), generator.random()
        if label.box_2d[3] - label.box_2d[1] >= MINIMUM_HEIGHT_PX:
            scored.append(_result_line(label, noise.tolist(), scale))
    return [line for _, line in sorted(scored, reverse=True)]


def _result_line(label: KittiObject, noise: Sequence[float], scale: float) -> tuple[float, str]:
    depth, lateral, yaw, vertical, tall, wide, long, luck = noise
    x, y, z = label.location_ref
    share = scale * DEPTH_SHARE * depth
    factor = 1 + min(max(share, -_MAXIMUM_DEPTH_SHARE), _MAXIMUM_DEPTH_SHARE)
    distance = math.hypot(x, z)
    sideways = scale * LATERAL_M * lateral
    x, z = factor * x + sideways * z / distance, factor * z - sideways * x / distance
    y += VERTICAL_M * vertical
    height, width, length = label.hwl
    height *= 1 + HEIGHT_SHARE * tall
    width, length = width * (1 + FOOTPRINT_SHARE * wide), length * (1 + FOOTPRINT_SHARE * long)
    rotation_y = _wrapped(label.rotation_y + math.radians(scale * YAW_DEG * yaw))
    score = min(max(0.9 - distance / 100 + 0.15 * luck, 0.01), 0.99)
    numbers = [*label.box_2d, max(height, 0.5), width, length, x, y, max(z, 1.0), rotation_y]
    alpha = _wrapped(rotation_y - math.atan2(x, z))
    return score, f"Car -1 -1 {alpha:.4f} " + " ".join(f"{n:.4f}" for n in numbers) + f" {score:.4f}"


def _wrapped(angle: float) -> float:
    return math.remainder(angle, math.tau)


def write_detections(folder: Path, labels: Labels, scale: float, seed: int) -> Path:
    """Write result files into `folder/data`; returns the folder. Files that hold the same text stay as they are."""
    for frame_id, lines in simulated_lines(labels, scale, seed).items():
        path = folder / "data" / f"{frame_id}.txt"
        text = "".join(f"{line}\n" for line in lines)
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            write_text(path, text)
    return folder
