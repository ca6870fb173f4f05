"""Average precision as KITTI measures it: frames, splits, folders, and input that cannot be used."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.kitti_lines import evaluate, line, objects

from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.evaluation.kitti_ap import evaluate_kitti


class TestWhatIsEvaluated:
    def test_a_frame_without_results_counts_as_missed(self) -> None:
        scores = evaluate_kitti({"1": objects(line()), "2": objects(line())}, {"2": objects(line(score=1))})
        assert (scores.num_frames, scores.num_frames_without_results) == (2, 1)
        assert scores.score("3d", 0.7, "easy").ap_area == 50

    def test_a_split_chooses_frames(self) -> None:
        labels = {name: objects(line()) for name in ("1", "2", "3")}
        results = {name: objects(line(shift=9 if name == "3" else 0, score=1)) for name in ("1", "2", "3", "4")}
        scores = evaluate_kitti(labels, results, split=["1", "2", "1"])
        assert (scores.num_frames, scores.num_result_frames_unused, scores.num_detections) == (2, 2, 2)
        assert scores.score("3d", 0.7, "easy").ap_area == 100

    def test_a_detector_without_3d_boxes_is_scored_in_the_image_alone(self) -> None:
        result = "Car -1 -1 -10 0 100 100 150 -1 -1 -1 -1000 -1000 -1000 -10 0.9"
        scores = evaluate([line()], [result])
        assert {score.metric for score in scores.scores} == {"2d"}
        assert scores.score("2d", 0.7, "easy").ap_area == 100
        with pytest.raises(InputError, match=r"expected 2d; .*got 3d"):
            scores.score("3d", 0.7, "easy")

    def test_empty_results_score_nothing_everywhere(self) -> None:
        scores = evaluate([line()], [])
        assert len(scores.scores) == 18
        assert all(score.ap_r40 == score.ap_r11 == score.ap_area == 0 for score in scores.scores)

    def test_no_counted_label(self) -> None:
        scores = evaluate([], [line(score=1)])
        assert all(score.num_labels == 0 and score.ap_r11 == 0 for score in scores.scores)


class TestFilesAndErrors:
    @pytest.fixture
    def folders(self, tmp_path: Path) -> tuple[Path, Path]:
        for folder, text in (("labels", line()), ("results/data", line(score=1))):
            (tmp_path / folder).mkdir(parents=True)
            for frame in ("000001", "000002"):
                (tmp_path / folder / f"{frame}.txt").write_text(text + "\n")
        return tmp_path / "labels", tmp_path / "results"

    def test_folders_and_a_split_file(self, folders: tuple[Path, Path], tmp_path: Path) -> None:
        (tmp_path / "val.txt").write_text("000002\n")
        assert evaluate_kitti(*folders).num_frames == 2
        scores = evaluate_kitti(str(folders[0]), str(folders[1] / "data"), split=str(tmp_path / "val.txt"))
        assert (scores.num_frames, scores.num_result_frames_unused) == (1, 1)
        assert scores.score("3d", 0.7, "easy").ap_area == 100

    def test_a_result_without_score(self, folders: tuple[Path, Path]) -> None:
        path = folders[1] / "data" / "000002.txt"
        path.write_text(f"{line(score=1)}\n\n{line(1)}\n")
        with pytest.raises(DataFormatError, match=r"000002.txt, line 3: a result without score: .*column 16"):
            evaluate_kitti(*folders)

    def test_a_broken_line_is_named(self, folders: tuple[Path, Path]) -> None:
        (folders[0] / "000001.txt").write_text("Car 0 0 zero 0 100 100 150 1.5 2 4 0 1.6 20 0\n")
        with pytest.raises(DataFormatError, match=r"000001.txt, line 1: column 4 is 'zero', not a finite number"):
            evaluate_kitti(*folders)

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
        with pytest.raises(InputError, match="labels of frame 000009, which the split names"):
            evaluate_kitti(*folders, split=["000001", "000009"])
