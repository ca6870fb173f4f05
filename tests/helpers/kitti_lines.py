"""This module has cars as separate lines of KITTI label and result files, and the scores of a frame of them."""

from __future__ import annotations

from directshape_torch.evaluation.kitti_ap import ApScore, KittiScores, score_frames
from directshape_torch.files.text_files import Line
from directshape_torch.io.kitti_labels import KittiObject, parse_object


def line(
    slot: int = 0,
    *,
    kind: str = "Car",
    height: float = 50,
    occluded: int = 0,
    truncated: float = 0,
    alpha: float = 0,
    score: float | None = None,
) -> str:
    """A car of 4 m x 2 m x 1.5 m in its own place, 300 px in the image and 10 m on the road from the next."""
    box_2d = f"{300 * slot} 100 {300 * slot + 100} {100 + height}"
    text = f"{kind} {truncated} {occluded} {alpha} {box_2d} 1.5 2 4 {10 * slot} 1.6 20 0"
    return text if score is None else f"{text} {score}"


def objects(*lines: str) -> list[KittiObject]:
    return [parse_object("a file", Line(number, text, text)) for number, text in enumerate(lines, start=1)]


def evaluate(labels: list[str], results: list[str], object_type: str = "Car") -> KittiScores:
    """The scores of one frame."""
    return score_frames([(objects(*labels), objects(*results))], object_type)


def precision(score: ApScore, count: int) -> list[float]:
    """The first values of the curve; the rest must be 0, as beyond the last threshold."""
    assert score.curve.precision.shape == (41,)
    assert not score.curve.precision[count:].any()
    return score.curve.precision[:count].tolist()
