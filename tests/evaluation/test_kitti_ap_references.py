"""KITTI's average precision agrees with a slow reference, and with known scores of real detectors."""

from __future__ import annotations

import json
import os
import random
import zipfile
from pathlib import Path

import numpy as np
import pytest
from helpers.kitti_devkit import devkit_curves
from helpers.kitti_lines import objects

from directshape_torch.evaluation.kitti_ap import evaluate_kitti, score_frames
from directshape_torch.io.kitti_labels import KittiObject

Frames = list[tuple[list[KittiObject], list[KittiObject]]]


def scenes(seed: int) -> Frames:
    """Frames with crowded boxes, with equal scores and overlaps, and with labels at the limits."""
    one_of = random.Random(seed).choice

    def thing(kinds: tuple[str, ...], scores: tuple[str, ...]) -> str:
        u, kind = one_of((0, 2, 5, 8, 60)), one_of(kinds)
        state = f"{one_of((0, 0.15, 0.2, 0.3, 0.4, 0.5))} {one_of((0, 0, 1, 2, 3))} {one_of((-1.0, 0.0, 2.0))}"
        box_2d = f"{u} 0 {u + one_of((60, 66))} {one_of((24.0, 24.9, 25.0, 26.0, 39.9, 40.0, 41.0))}"
        # Heights in space that overlap by less than what is seen from above, and by one half.
        box_3d = f"{one_of((1.0, 1.5, 2.0))} 2 4 {one_of((0.0, 0.2, 0.5, 0.6, 8.0))} 1.6 20 0"
        if kind == "DontCare":
            state, box_3d = "-1 -1 -10", "-1 -1 -1 -1000 -1000 -1000 0"
        return f"{kind} {state} {box_2d} {box_3d} {one_of(scores)}".strip()

    def things(most: int, kinds: tuple[str, ...], *scores: str) -> list[KittiObject]:
        return objects(*(thing(kinds, scores) for _ in range(one_of(range(most + 1)))))

    labels, results = ("Car", "Car", "Car", "Van", "Truck", "DontCare"), ("Car", "Car", "Car", "Cyclist")
    return [(things(5, labels, ""), things(6, results, "0.1", "0.3", "0.5", "0.9")) for _ in range(one_of((1, 4, 8)))]


@pytest.mark.parametrize("seed", range(20))
def test_equals_the_devkit_taken_frame_by_frame(seed: int) -> None:
    frames = scenes(seed)
    for score in score_frames(frames).scores:
        expected, orientation = devkit_curves(frames, score.metric, score.minimum_iou, score.difficulty)
        np.testing.assert_allclose(score.curve.precision, expected, atol=1e-12)
        if score.metric == "2d":
            np.testing.assert_allclose(score.curve.orientation, orientation, atol=1e-12)


@pytest.mark.skipif("DIRECTSHAPE_DATA" not in os.environ, reason="DIRECTSHAPE_DATA is not set: KITTI labels needed")
@pytest.mark.long
@pytest.mark.parametrize("detector", ["frustum_pointnet", "pointgnn"])
def test_agrees_with_known_scores_in_every_cell(tmp_path: Path, detector: str) -> None:
    """3769 frames; the curves of the first detector at IoU 0.7 are the official evaluator's, six decimals."""
    root = Path(os.environ["DIRECTSHAPE_DATA"]) / "kitti_eval"
    known = json.loads((root / "expected.json").read_text())
    labels = _extract(root / "label_2.zip", tmp_path) / "label_2"
    results = _extract(root / known[detector]["results"], tmp_path / "results")
    scores = evaluate_kitti(labels, results, split=root / "val.txt")
    assert (scores.num_frames, scores.num_frames_without_results, len(scores.scores)) == (3769, 0, 18)
    for score in scores.scores:
        iou = str(score.minimum_iou)
        cell = known[detector]["reimplementation"][score.metric][iou][score.difficulty]
        assert score.num_labels == cell["n_gt"]
        assert (score.ap_r11, score.ap_r40) == pytest.approx((cell["R11"], cell["R40"]), abs=1e-3)
        curve = known["precision_curves"][detector][f"{score.metric}_{iou}_{score.difficulty}"]
        np.testing.assert_allclose(score.curve.precision, curve, atol=1e-6)


def _extract(archive: Path, folder: Path) -> Path:
    with zipfile.ZipFile(archive) as file:
        file.extractall(folder)
    return folder
