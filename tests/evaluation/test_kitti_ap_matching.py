"""Average precision as KITTI measures it: which detection takes which label, every rule by hand."""

from __future__ import annotations

import math

import pytest
from helpers.kitti_lines import evaluate, line, objects, precision

from directshape_torch.evaluation.kitti_ap import evaluate_kitti


class TestMatching:
    def test_overlap_must_be_larger_than_the_threshold(self) -> None:
        """Half of the box is an IoU of exactly one half."""
        half, more = (evaluate([line()], [line(width=width, score=1)]) for width in (50, 51))
        assert half.score("2d", 0.5, "easy").ap_area == 0
        assert more.score("2d", 0.5, "easy").ap_area == 100

    def test_each_metric_looks_at_its_own_box(self) -> None:
        """A shift by 0.5 of 4 m leaves (4 - 0.5) / (4 + 0.5) = 0.78, one by 1 m 0.6, one by 2 m 1/3."""
        for shift, found in ((0.5, {0.7, 0.5}), (1, {0.5}), (2, set())):
            scores = evaluate([line()], [line(shift=shift, score=1)])
            for iou in (0.7, 0.5):
                assert scores.score("2d", iou, "easy").ap_area == 100
                for metric in ("bev", "3d"):
                    assert scores.score(metric, iou, "easy").ap_area == (100 if iou in found else 0)

    def test_thresholds_take_the_best_score_and_counting_the_largest_overlap(self) -> None:
        """Of label 0, A overlaps more and B scores higher; the thresholds are B's score and that of label 1.

        Above 0.8 there is B alone: 1 of 1 is right, its orientation too. Above 0.2 label 0 takes A, whose alpha is off
        by a quarter turn (similarity 1/2), B is wrong and label 1 is found: 2 of 3 are right, similarity 1.5 of 3.
        """
        a, b = line(width=99, alpha=math.pi / 2, score=0.3), line(width=80, score=0.8)
        score = evaluate([line(), line(1)], [a, b, line(1, score=0.2)]).score("2d", 0.7, "easy")
        assert score.curve.thresholds.tolist() == [0.8, 0.2]
        assert precision(score, 2) == pytest.approx([1, 2 / 3])
        assert score.curve.orientation is not None
        assert score.curve.orientation[:3].tolist() == pytest.approx([1, 0.5, 0])

    def test_a_detection_serves_one_label(self) -> None:
        score = evaluate([line(), line()], [line(score=1)]).score("3d", 0.7, "easy")
        assert score.num_labels == 2
        assert (precision(score, 1), score.curve.recall.tolist()) == ([1], [0.5])

    def test_frames_do_not_mix(self) -> None:
        labels = {"1": objects(line()), "2": objects(line())}
        results = {"1": objects(line(score=0.9), line(score=0.8)), "2": []}
        score = evaluate_kitti(labels, results).score("3d", 0.7, "easy")
        assert (precision(score, 1), score.curve.recall.tolist()) == ([1], [0.5])
