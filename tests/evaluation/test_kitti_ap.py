"""KITTI's average precision agrees with figures by hand, for frames and files; another file has the devkit."""

from __future__ import annotations

import math
import unicodedata
from pathlib import Path

import numpy as np
import pytest
from helpers.kitti_lines import evaluate, line, objects, precision

from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.evaluation.kitti_ap import evaluate_kitti, score_frames
from directshape_torch.evaluation.kitti_rules import score_thresholds

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


class TestNeighboursAndRegions:
    def test_people_who_sit_are_neighbours_of_pedestrians_whatever_the_case(self) -> None:
        labels = [line(kind="pedestrian"), line(1, kind="Person_sitting")]
        results = [line(kind="Pedestrian", score=0.5), line(1, kind="PEDESTRIAN", score=0.9), line(2, score=1)]
        score = evaluate(labels, results, "Pedestrian").score("bev", 0.5, "easy")
        assert precision(score, 1) == [1]

    def test_detections_in_a_region_nobody_labelled_are_not_wrong_in_the_image(self) -> None:
        """The region holds 60 of 100 columns of the detection: 0.6 of its own area, whatever the region's."""
        region = "DontCare -1 -1 -10 340 0 900 900 -1 -1 -1 -1000 -1000 -1000 -10"
        scores = evaluate([line(), region], [line(score=0.5), line(1, score=0.9)])
        assert precision(scores.score("2d", 0.5, "easy"), 1) == [1]
        assert precision(scores.score("2d", 0.7, "easy"), 1) == [0.5]
        for metric in ("bev", "3d"):
            assert precision(scores.score(metric, 0.5, "easy"), 1) == [0.5]


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

    def test_thresholds_come_as_close_to_each_recall_as_they_can(self) -> None:
        """Of 80 labels the first is closest to recall 0, and then every second is one fortieth further."""
        assert score_thresholds(np.arange(80.0, 0, -1), 80).tolist() == [80, *range(79, 0, -2)]

    def test_half_found(self) -> None:
        """40 of 80: thresholds at recall 0, 1/40 .. 20/40, where precision is 1: 6 of 11 and 20 of 40 points."""
        frames = [(objects(line()), objects(line(score=k)) if k < 40 else []) for k in range(80)]
        score = score_frames(frames).score("3d", 0.7, "easy")
        assert (score.ap_r11, score.ap_r40, score.ap_area) == pytest.approx((600 / 11, 50, 50))
        assert score.num_labels == 80


class TestOrientation:
    @pytest.mark.parametrize(("off_by", "percent"), [(0, 100), (math.pi / 3, 75), (math.pi / 2, 50), (math.pi, 0)])
    def test_all_off_by_the_same_angle(self, off_by: float, percent: float) -> None:
        frames = [(objects(line(alpha=1)), objects(line(alpha=1 - off_by, score=k))) for k in range(41)]
        score = score_frames(frames).score("2d", 0.7, "easy")
        assert (score.ap_r40, score.aos_r11, score.aos_r40) == pytest.approx((100, percent, percent))

    def test_it_belongs_to_image_boxes(self) -> None:
        scores = evaluate([line()], [line(score=1)])
        assert scores.score("2d", 0.7, "easy").aos_r11 == pytest.approx(100 / 11)
        for metric in ("bev", "3d"):
            score = scores.score(metric, 0.7, "easy")
            assert (score.aos_r11, score.aos_r40, score.curve.orientation) == (None, None, None)

    def test_one_result_without_alpha_leaves_it_out(self) -> None:
        scores = evaluate([line()], [line(score=1), line(1, kind="Cyclist", alpha=-10, score=0.1)])
        assert scores.score("2d", 0.7, "easy").aos_r40 is None


class TestFilesAndErrors:
    @pytest.fixture
    def folders(self, tmp_path: Path) -> tuple[Path, Path]:
        for folder, text in (("labels", line()), ("results/data", line(score=1))):
            (tmp_path / folder).mkdir(parents=True)
            for frame in ("000001", "000002"):
                (tmp_path / folder / f"{frame}.txt").write_text(text + "\n")
        return tmp_path / "labels", tmp_path / "results"

    def test_accents_may_be_written_differently_in_each_folder(self, tmp_path: Path) -> None:
        names = [
            tmp_path / folder / unicodedata.normalize(form, "é1.txt") for folder, form in (("a", "NFC"), ("b", "NFD"))
        ]
        for path, text in zip(names, (line(), line(score=1)), strict=True):
            path.parent.mkdir()
            path.write_text(text + "\n")
        assert evaluate_kitti(tmp_path / "a", tmp_path / "b").score("3d", 0.7, "easy").ap_area == 100
        for name in (path.stem for path in names):
            assert evaluate_kitti(tmp_path / "b", tmp_path / "b", frames=[name]).num_frames == 1

    def test_a_folder_that_is_missing(self, folders: tuple[Path, Path]) -> None:
        with pytest.raises(DataFormatError, match="labl: is no folder of labels"):
            evaluate_kitti(folders[0].parent / "labl", folders[1])
        with pytest.raises(DataFormatError, match="result: is no folder of results"):
            evaluate_kitti(folders[0], folders[1].parent / "result")

    def test_folders_without_files(self, folders: tuple[Path, Path], tmp_path: Path) -> None:
        (tmp_path / "empty").mkdir()
        with pytest.raises(InputError, match=r"labels: expected label files NNNNNN\.txt"):
            evaluate_kitti(tmp_path / "empty", folders[1])
        with pytest.raises(InputError, match=r"results: expected result files such as 000001\.txt"):
            evaluate_kitti(folders[0], tmp_path / "empty")

    def test_a_split_with_a_frame_that_has_no_labels(self, folders: tuple[Path, Path]) -> None:
        with pytest.raises(InputError, match=r"frames with labels in .*, such as 000001, got 000009"):
            evaluate_kitti(*folders, frames=[1, "000009"])
        with pytest.raises(
            InputError, match=r"frames: expected at least one of the frames with labels in .*, got none"
        ):
            evaluate_kitti(*folders, frames=[])
