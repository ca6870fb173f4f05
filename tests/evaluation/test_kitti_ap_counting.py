"""Average precision as KITTI measures it: which labels count and which detections are wrong, every rule by hand."""

from __future__ import annotations

import pytest
from helpers.kitti_lines import evaluate, line, precision

DIFFICULTIES = ("easy", "moderate", "hard")


class TestDifficulty:
    @pytest.mark.parametrize(
        ("label", "counts"),
        [
            (line(height=40.5, occluded=0, truncated=0.15), (1, 1, 1)),
            (line(height=40), (0, 1, 1)),  # a label must be HIGHER than 40 px
            (line(height=25.5, occluded=1, truncated=0.30), (0, 1, 1)),
            (line(height=25), (0, 0, 0)),
            (line(occluded=1), (0, 1, 1)),
            (line(occluded=2), (0, 0, 1)),
            (line(occluded=3), (0, 0, 0)),
            (line(truncated=0.16), (0, 1, 1)),
            (line(truncated=0.31), (0, 0, 1)),
            (line(truncated=0.51), (0, 0, 0)),
            (line(kind="Van"), (0, 0, 0)),
            (line(kind="DontCare"), (0, 0, 0)),
        ],
    )
    def test_which_labels_count(self, label: str, counts: tuple[int, int, int]) -> None:
        scores = evaluate([label], [line(score=1)])
        assert tuple(scores.score("3d", 0.7, name).num_labels for name in DIFFICULTIES) == counts

    @pytest.mark.parametrize(("height", "easy", "moderate"), [(40, 1 / 2, 1 / 2), (39.9, 1, 1 / 2), (24.9, 1, 1)])
    def test_a_wrong_detection_counts_from_the_least_height_on(
        self, height: float, easy: float, moderate: float
    ) -> None:
        scores = evaluate([line()], [line(1, height=height, score=0.9), line(score=0.5)])
        assert precision(scores.score("3d", 0.7, "easy"), 1) == [easy]
        assert precision(scores.score("3d", 0.7, "moderate"), 1) == [moderate]

    def test_finding_a_label_that_is_too_hard_is_neither_right_nor_wrong(self) -> None:
        scores = evaluate([line(), line(1, occluded=2)], [line(score=0.5), line(1, score=0.9)])
        assert precision(scores.score("3d", 0.7, "moderate"), 1) == [1]
        assert precision(scores.score("3d", 0.7, "hard"), 2) == [1, 1]

    def test_a_small_detection_is_taken_only_where_there_is_no_other(self) -> None:
        """The small box overlaps its label by 24/26, the full one by 26/30; only the full one can be right."""
        labels, other = [line(height=26), line(1)], line(1, score=0.7)
        small, full = line(height=24, score=0.9), line(height=30, score=0.8)
        both, alone = (evaluate(labels, [small, *more, other]).score("2d", 0.7, "hard") for more in ([full], []))
        # The small one has the better score and hides the full one's from the choice of thresholds.
        assert both.curve.thresholds.tolist() == alone.curve.thresholds.tolist() == [0.7]
        assert (precision(both, 1), both.curve.recall.tolist()) == ([1], [1])
        assert (precision(alone, 1), alone.curve.recall.tolist()) == ([1], [0.5])

    def test_a_small_detection_of_another_class_is_ignored_too(self) -> None:
        """The devkit asks for the height first: the small cyclist takes the car, which then cannot be right."""
        small, full = line(kind="Cyclist", height=24, score=0.9), line(kind="Cyclist", height=26, score=0.9)
        for cyclist, thresholds in ((small, [0.7]), (full, [0.8, 0.7])):
            results = [cyclist, line(height=26, score=0.8), line(1, score=0.7)]
            score = evaluate([line(height=26), line(1)], results).score("2d", 0.7, "hard")
            assert score.curve.thresholds.tolist() == thresholds


class TestNeighboursAndRegions:
    def test_a_van_may_be_found_and_may_be_missed(self) -> None:
        for results in ([line(score=0.5), line(1, score=0.9)], [line(score=0.5)]):
            score = evaluate([line(), line(1, kind="Van")], results).score("3d", 0.7, "easy")
            assert precision(score, 1) == [1]
            assert score.ap_area == 100

    def test_a_detection_of_a_lorry_is_wrong(self) -> None:
        scores = evaluate([line(), line(1, kind="Truck")], [line(score=0.5), line(1, score=0.9)])
        assert precision(scores.score("3d", 0.7, "easy"), 1) == [0.5]

    def test_people_who_sit_are_neighbours_of_pedestrians_whatever_the_case(self) -> None:
        labels = [line(kind="pedestrian"), line(1, kind="Person_sitting")]
        results = [line(kind="Pedestrian", score=0.5), line(1, kind="PEDESTRIAN", score=0.9), line(2, score=1)]
        score = evaluate(labels, results, "Pedestrian").score("bev", 0.5, "easy")
        assert precision(score, 1) == [1]

    def test_a_van_in_the_results_is_no_car(self) -> None:
        scores = evaluate([line()], [line(kind="Van", score=0.9)])
        assert scores.num_detections == 0
        assert scores.score("2d", 0.5, "easy").ap_area == 0

    def test_detections_in_a_region_nobody_labelled_are_not_wrong_in_the_image(self) -> None:
        """The region holds 60 of 100 columns of the detection: 0.6 of its own area, whatever the region's."""
        region = "DontCare -1 -1 -10 340 0 900 900 -1 -1 -1 -1000 -1000 -1000 -10"
        scores = evaluate([line(), region], [line(score=0.5), line(1, score=0.9)])
        assert precision(scores.score("2d", 0.5, "easy"), 1) == [1]
        assert precision(scores.score("2d", 0.7, "easy"), 1) == [0.5]
        for metric in ("bev", "3d"):
            assert precision(scores.score(metric, 0.5, "easy"), 1) == [0.5]

    def test_two_regions_excuse_a_detection_once(self) -> None:
        region = "DontCare -1 -1 -10 290 0 900 900 -1 -1 -1 -1000 -1000 -1000 -10"
        results = [line(score=0.5), line(1, score=0.9), line(1, score=0.8), line(5, score=0.7)]
        scores = evaluate([line(), region, region], results)
        assert precision(scores.score("2d", 0.7, "easy"), 1) == [0.5]
