"""The figures of a comparison of result folders agree with values derived by hand for a small data set."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from helpers.shape_arrays import shape_arrays

from directshape_torch.cli.main import main
from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.evaluation.comparison import compare_results
from directshape_torch.evaluation.matching import chosen_frames, objects_of_frame
from directshape_torch.evaluation.reports import format_comparison
from directshape_torch.io.result_files import ShapeArrays, write_shapes

BOXES_2D = {
    "near": "100 100 200 180",
    "middle": "300 100 360 140",
    "far": "500 100 530 126",
    "small": "700 100 720 120",
}


def _line(
    which: str, x: float, z: float, kind: str = "Car", yaw: float = 0.0, occluded: int = 0, score: str = ""
) -> str:
    return f"{kind} 0 {occluded} 0 {BOXES_2D[which]} 1.5 2 4 {x} 1.6 {z} {yaw} {score}".strip()


def _write(folder: Path, **frames: list[str]) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for frame, lines in frames.items():
        (folder / f"{frame[1:]}.txt").write_text("".join(f"{line}\n" for line in lines))
    return folder


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path, Path]:
    """Folders with boxes of 4 x 2 m along x, for which a shift by s in x gives an IoU of (4 - s) / (4 + s).

    The shifts are 2, 1, 0.4 before and 0, 1, 1 after. The small label and the occluded one do not count.
    """
    labels = _write(
        tmp_path / "labels",
        f000001=[_line("near", 0, 8), _line("middle", 5, 25), _line("small", 9, 60)],
        f000002=[
            _line("far", 2, 40),
            _line("near", 9, 9, occluded=2),
            "DontCare -1 -1 -10 0 0 9 9 -1 -1 -1 -1000 -1000 -1000 -10",
        ],
    )
    before = _write(
        tmp_path / "before" / "data",
        f000001=[
            _line("middle", 6, 25, score="0.8"),
            _line("near", 2, 8, score="0.9"),
            _line("small", 9, 60, score="0.1"),
        ],
        f000002=[_line("near", 9, 9, score="0.5"), _line("far", 2.4, 40, score="0.7")],
    )
    after = _write(
        tmp_path / "after",
        f000001=[
            _line("middle", 6, 25, score="0.8"),
            _line("near", 0, 8, score="0.9"),
            _line("small", 9, 60, score="0.1"),
        ],
        f000002=[_line("near", 9, 9, score="0.5"), _line("far", 3, 40, score="0.7")],
    )
    return labels, before.parent, after


def test_every_figure(folders: tuple[Path, Path, Path]):
    comparison = compare_results(*folders)
    assert comparison.num_frames == 2
    assert comparison.num_labels_counted == 3
    assert [(c.frame_id, c.detection_line, c.label_line) for c in comparison.cars] == [
        ("000001", 1, 2),
        ("000001", 2, 1),
        ("000002", 2, 1),
    ]
    overall = comparison.overall
    assert overall.num_detections == 3
    metrics = overall.metrics
    before = (3 / 5, 2 / 6, 3.6 / 4.4)
    after = (3 / 5, 1.0, 3 / 5)
    assert metrics["bev_iou_mean"].before.value == pytest.approx(np.mean(before))
    assert metrics["bev_iou_mean"].after.value == pytest.approx(np.mean(after))
    assert metrics["bev_iou_mean"].change.value == pytest.approx(np.mean(after) - np.mean(before))
    # All boxes stand on the same ground and are of one height.
    assert metrics["iou_3d_mean"].before.value == pytest.approx(np.mean(before))
    assert metrics["bev_iou_good_share"].before.value == pytest.approx(1 / 3)
    assert metrics["centre_m_median"].before.value == pytest.approx(1.0)
    assert metrics["centre_m_median"].after.value == pytest.approx(1.0)
    assert metrics["yaw_deg_median"].after.value == pytest.approx(0.0)
    assert overall.worse_share.value == pytest.approx(1 / 3)
    assert overall.worse_share.low == 0
    groups = {group.name: group.num_detections for group in comparison.by_depth}
    assert groups == {"0-10 m": 1, "10-20 m": 0, "20-30 m": 1, "30-45 m": 1, "over 45 m": 0}


def _shapes(frame_id: str, lines: list[int], statuses: list[str]) -> ShapeArrays:
    return shape_arrays(
        len(lines),
        frame_id=frame_id,
        input_lines=np.array(lines, dtype=np.int64),
        statuses=tuple(statuses),
        has_mask_left=np.array([status != "no_mask" for status in statuses]),
    )


def test_cars_without_a_mask_are_left_out(folders: tuple[Path, Path, Path], tmp_path: Path):
    write_shapes(tmp_path / "shapes" / "000001.npz", _shapes("000001", [1, 2, 3], ["converged", "no_mask", "no_mask"]))
    write_shapes(tmp_path / "shapes" / "000002.npz", _shapes("000002", [2], ["rejected_worse"]))
    comparison = compare_results(*folders, shapes_dir=tmp_path / "shapes")
    assert [(c.frame_id, c.detection_line) for c in comparison.cars] == [("000001", 1), ("000002", 2)]
    assert comparison.num_filtered_out == 1
    assert "1 more detections have no left mask" in format_comparison(comparison)
    assert compare_results(*folders, shapes_dir=tmp_path) == comparison


def test_frames_and_split_choose(folders: tuple[Path, Path, Path], tmp_path: Path):
    (tmp_path / "split.txt").write_text("000002\n")
    assert compare_results(*folders, split=tmp_path / "split.txt").overall.num_detections == 1
    assert compare_results(*folders, frames=[1]).overall.num_detections == 2
    with pytest.raises(InputError, match=r"frames: expected frames of .*, such as 000002, got 1"):
        compare_results(*folders, split=tmp_path / "split.txt", frames=[1])
    with pytest.raises(InputError, match=r"frames: expected at least one of the frames of .*, got none"):
        compare_results(*folders, frames=[])


def test_files_that_do_not_belong_together_are_named(folders: tuple[Path, Path, Path]):
    path = folders[2] / "000002.txt"
    whole = path.read_text()
    path.write_text(whole.splitlines()[0] + "\n")
    with pytest.raises(DataFormatError, match=r"after/000002.txt: has 1 lines, .*before/data/000002.txt has 2"):
        compare_results(*folders)
    path.write_text(whole.replace("Car", "Van", 1))
    with pytest.raises(DataFormatError, match=r"after/000002.txt, line 1: does not belong to line 1"):
        compare_results(*folders)
    path.unlink()
    with pytest.raises(DataFormatError, match=r"after/000002\.txt: there is no result of frame 000002; .*--split"):
        compare_results(*folders)


def test_empty_files_and_no_files(tmp_path: Path):
    parts = [_write(tmp_path / name, f000001=[]) for name in ("labels", "before", "after")]
    comparison = compare_results(*parts)
    assert comparison.cars == ()
    assert comparison.overall.worse_share is None
    assert "nothing to compare" in format_comparison(comparison)
    (tmp_path / "none").mkdir()
    with pytest.raises(InputError, match=r"frames: expected at least one frame"):
        compare_results(parts[0], tmp_path / "none", parts[2])


def test_files_of_the_tracking_benchmark(folders: tuple[Path, Path, Path], tmp_path: Path):
    expected = [(car.before, car.after) for car in compare_results(*folders).cars]
    sequences = []
    for folder in (folders[0], folders[1] / "data"):
        lines = [f"{int(p.stem)} 7 {line}\n" for p in sorted(folder.iterdir()) for line in p.read_text().splitlines()]
        sequences.append(tmp_path / folder.parent.name / f"of_{folder.name}")
        sequences[-1].mkdir(parents=True)
        (sequences[-1] / "0005.txt").write_text("".join(lines))
    one = compare_results(*(folder / "0005.txt" for folder in sequences), folders[2])
    assert [(car.before, car.after) for car in one.cars] == expected
    for path in list(folders[2].iterdir()):
        path.rename(path.with_name(f"0005_{path.name}"))
    several = compare_results(*sequences, folders[2])
    assert [(car.before, car.after) for car in several.cars] == expected
    assert [car.frame_id for car in several.cars] == ["0005_000001", "0005_000001", "0005_000002"]
    # A folder for each sequence, as the refinement takes detections too.
    apart = tmp_path / "apart" / "0005"
    apart.parent.mkdir()
    (folders[1] / "data").rename(apart)
    assert compare_results(sequences[0], apart.parent, folders[2]).cars == several.cars
    # Folders and files beside each other, whatever else lies there.
    lines = (apart / "000002.txt").read_text().splitlines()
    (apart / "000002.txt").unlink()
    (folders[2] / "0005_000002.txt").rename(folders[2] / "0006_000002.txt")
    (apart.parent / "0006.txt").write_text("".join(f"2 7 {line}\n" for line in lines))
    (apart.parent / "README.txt").write_text("Detections.\n")
    (sequences[0] / "0006.txt").write_text((sequences[0] / "0005.txt").read_text())
    mixed = compare_results(sequences[0], apart.parent, folders[2])
    assert [(car.before, car.after) for car in mixed.cars] == expected
    (folders[2] / "0006_000002.txt").rename(folders[2] / "0005_000002.txt")
    with pytest.raises(InputError, match="such as 0005_000001, got 0005_first"):
        compare_results(*sequences, folders[2], frames=["0005_first"])


def test_files_of_stereo_2015_may_leave_out_which_pair_they_are_of(folders: tuple[Path, Path, Path]) -> None:
    expected = compare_results(*folders)
    for path in list(folders[2].iterdir()):
        path.rename(path.with_name(f"{path.stem}_10.txt"))
    found = compare_results(*folders)
    assert [(car.before, car.after) for car in found.cars] == [(car.before, car.after) for car in expected.cars]
    assert found.cars[0].frame_id == "000001_10"


@pytest.mark.parametrize(("file", "frame"), [("000007/000007.txt", "000007_000007"), ("3/data/000007.txt", "3_000007")])
def test_a_file_in_the_folder_of_its_sequence_is_one_of_a_frame(tmp_path: Path, file: str, frame: str) -> None:
    (tmp_path / file).parent.mkdir(parents=True)
    (tmp_path / file).write_text(_line("near", 0, 8, score="0.5") + "\n")
    assert len(objects_of_frame(tmp_path, frame)) == 1
    # A file of the tracking benchmark may be called as a frame of another sequence.
    (tmp_path / "000008.txt").write_text("7 1 " + _line("near", 0, 8, score="0.5") + "\n")
    assert len(objects_of_frame(tmp_path / "000008.txt", "0005_000007")) == 1


def test_a_split_of_drives_serves_the_evaluation(tmp_path: Path) -> None:
    (tmp_path / "split.txt").write_text("2011_09_26/2011_09_26_drive_0005_sync 0000000007 l\n")
    assert chosen_frames(["0000000005", "0000000007"], None, tmp_path / "split.txt", "frames") == ["0000000007"]


def test_command_prints_and_writes(
    folders: tuple[Path, Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    names = ("--labels", "--before", "--after")
    options = [text for pair in zip(names, map(str, folders), strict=True) for text in pair]
    outputs = ["--json", str(tmp_path / "c.json"), "--csv", str(tmp_path / "c.csv"), "--draws", "50"]
    assert main(["compare", *options, *outputs]) == 0
    printed = capsys.readouterr().out
    assert "3 detections of 3 counted labels in 2 frames" in printed
    assert "BEV IoU, mean" in printed
    content = json.loads((tmp_path / "c.json").read_text())
    assert content["schema_version"] == 1
    assert content["overall"]["metrics"]["bev_iou_mean"]["after"]["value"] == pytest.approx((0.6 + 1 + 0.6) / 3)
    with (tmp_path / "c.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["bev_iou_after"]) for row in rows] == pytest.approx([0.6, 1.0, 0.6], abs=1e-5)
    assert [row["depth_m"] for row in rows] == ["25", "8", "40"]


def test_results_without_boxes_before_are_measured_alone(folders: tuple[Path, Path, Path], tmp_path: Path) -> None:
    labels, _, after = folders
    (after / "000002.txt").write_text(f"Car -1 -1 -10 {BOXES_2D['far']} -1 -1 -1 -1000 -1000 -1000 -10 0.7\n")
    found = compare_results(labels, None, after)
    metrics = found.overall.metrics
    # The line without a box is the third of the counted cars.
    assert metrics["bev_iou_mean"].after.value == pytest.approx((1 + 0.6 + 0) / 3)
    assert metrics["yaw_axis_good_share"].after.value == pytest.approx(2 / 3)
    assert metrics["bev_iou_mean"].before is None
    assert metrics["bev_iou_mean"].change is None
    assert found.overall.worse_share is None
    assert [car.before for car in found.cars] == [None] * 3
    table = tmp_path / "cars.csv"
    command = ["compare", "--labels", str(labels), "--after", str(after), "--csv", str(table)]
    assert main([*command, "--json", str(tmp_path / "all.json")]) == 0
    with table.open() as file:
        assert [row["bev_iou_before"] for row in csv.DictReader(file)] == [""] * 3
    content = json.loads((tmp_path / "all.json").read_text())
    assert content["overall"]["metrics"]["centre_m_median"]["before"] is None
    assert "->" not in format_comparison(found)


@pytest.mark.parametrize("named", ["", "frames"])
def test_a_run_of_a_plain_folder_is_compared_with_its_labels(tmp_path: Path, named: str) -> None:
    """A box that was 1 m off along its length is right after: 3 / 5 to 1."""

    def entry(x: float) -> dict[str, object]:
        box = {"dimensions_hwl_m": [1.5, 2.0, 4.0], "bottom_center_m": [x, 1.6, 12.0], "rotation_y_rad": 0.0}
        return {"class": "Car", "box_2d": [100, 100, 220, 180], **box}

    frame = {"schema_version": 1, "objects": [entry(1.0)], "labels": [entry(0.0)]}
    (tmp_path / "data" / "frames").mkdir(parents=True)
    (tmp_path / "data" / "frames" / "a 7.json").write_text(json.dumps(frame))
    folder = tmp_path / "data" / named
    after = _write(tmp_path / "out" / "data", **{"fa 7": ["Car -1 -1 0 100 100 220 180 1.5 2 4 0 1.6 12 0 1"]})
    comparison = compare_results(folder, folder, after.parent)
    (car,) = comparison.cars
    assert (car.frame_id, car.before.bev_iou, car.after.bev_iou) == ("a 7", pytest.approx(0.6), pytest.approx(1.0))
    del frame["labels"]
    (tmp_path / "data" / "frames" / "a 7.json").write_text(json.dumps(frame))
    with pytest.raises(DataFormatError, match=r"a 7\.json: holds no 'labels'"):
        compare_results(folder, folder, after.parent)
