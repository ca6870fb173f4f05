"""Average precision as KITTI measures it: thresholds, precision, orientation and distance, computed by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from helpers.kitti_lines import evaluate, line, objects, precision

from directshape_torch.evaluation.kitti_ap import evaluate_kitti
from directshape_torch.evaluation.kitti_curve import score_thresholds


class TestCurve:
    def test_precision_is_the_best_at_any_lower_threshold(self) -> None:
        """From the top: right, wrong, right, right: 1/1, 2/3, 3/4, so the second becomes 3/4."""
        results = [line(0, score=0.9), line(7, score=0.8), line(1, score=0.7), line(2, score=0.6)]
        score = evaluate([line(0), line(1), line(2)], results).score("3d", 0.7, "easy")
        assert precision(score, 3) == [1, 0.75, 0.75]
        assert score.curve.recall.tolist() == pytest.approx([1 / 3, 2 / 3, 1])
        # R11 takes every fourth of 41 values, of which the first is 1; R40 leaves the first out.
        assert score.ap_r11 == pytest.approx(100 / 11)
        assert score.ap_r40 == pytest.approx(100 * 1.5 / 40)
        assert score.ap_area == pytest.approx(100 * 2.5 / 3)

    @pytest.mark.parametrize("num_labels", [41, 80, 200])
    def test_everything_found_is_100_percent(self, num_labels: int) -> None:
        labels = {str(k): objects(line()) for k in range(num_labels)}
        results = {str(k): objects(line(score=k)) for k in range(num_labels)}
        score = evaluate_kitti(labels, results).score("3d", 0.7, "easy")
        assert (score.ap_r11, score.ap_r40, score.ap_area) == pytest.approx((100, 100, 100))

    def test_thresholds_come_as_close_to_each_recall_as_they_can(self) -> None:
        """Of 80 labels the first is closest to recall 0, and then every second is one fortieth further."""
        assert score_thresholds(np.arange(80.0, 0, -1), 80).tolist() == [80, *range(79, 0, -2)]

    def test_the_last_score_is_always_a_threshold(self) -> None:
        """The third of 80 would be passed over for the fourth, if there were one."""
        assert score_thresholds(np.array([3.0, 2, 1]), 80).tolist() == [3, 2, 1]

    def test_half_found(self) -> None:
        """40 of 80: thresholds at recall 0, 1/40 .. 20/40, where precision is 1: 6 of 11 and 20 of 40 points."""
        labels = {str(k): objects(line()) for k in range(80)}
        results = {str(k): objects(line(score=k)) for k in range(40)}
        scores = evaluate_kitti(labels, results)
        score = scores.score("3d", 0.7, "easy")
        assert scores.num_frames_without_results == 40
        assert (score.ap_r11, score.ap_r40, score.ap_area) == pytest.approx((600 / 11, 50, 50))

    def test_scores_may_have_any_range(self) -> None:
        scores = evaluate([line(), line(1)], [line(score=-3000), line(1, score=1e12)])
        assert scores.score("3d", 0.7, "easy").curve.thresholds.tolist() == [1e12, -3000]


class TestOrientation:
    @pytest.mark.parametrize(("off_by", "percent"), [(0, 100), (math.pi / 3, 75), (math.pi / 2, 50), (math.pi, 0)])
    def test_all_off_by_the_same_angle(self, off_by: float, percent: float) -> None:
        labels = {str(k): objects(line(alpha=1)) for k in range(41)}
        results = {str(k): objects(line(alpha=1 - off_by, score=k)) for k in range(41)}
        score = evaluate_kitti(labels, results).score("2d", 0.7, "easy")
        assert (score.ap_r40, score.aos_r11, score.aos_r40) == pytest.approx((100, percent, percent))

    def test_wrong_detections_have_no_similarity(self) -> None:
        scores = evaluate([line()], [line(score=0.5), line(1, score=0.9)])
        orientation = scores.score("2d", 0.7, "easy").curve.orientation
        assert orientation is not None
        assert orientation[:2].tolist() == [0.5, 0]

    def test_it_belongs_to_image_boxes(self) -> None:
        scores = evaluate([line()], [line(score=1)])
        assert scores.score("2d", 0.7, "easy").aos_r11 == pytest.approx(100 / 11)
        for metric in ("bev", "3d"):
            score = scores.score(metric, 0.7, "easy")
            assert (score.aos_r11, score.aos_r40, score.curve.orientation) == (None, None, None)

    def test_one_result_without_alpha_leaves_it_out(self) -> None:
        scores = evaluate([line()], [line(score=1), line(1, kind="Cyclist", alpha=-10, score=0.1)])
        assert scores.score("2d", 0.7, "easy").aos_r40 is None
