"""These tests check the output, the files and the errors of `directshape evaluate`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from directshape_torch.cli.main import main

CAR = "Car 0 0 {alpha} 100 100 200 150 1.5 2 4 0 1.6 {z} 0"


@pytest.fixture
def folders(tmp_path: Path) -> tuple[str, str]:
    """Folders of 45 frames with one car each, 15 m away, all found; the last frame has no result file."""
    labels, results = tmp_path / "labels", tmp_path / "results" / "data"
    for folder in (labels, results):
        folder.mkdir(parents=True)
    for frame in range(45):
        (labels / f"{frame:06d}.txt").write_text(CAR.format(alpha=0, z=15) + "\n")
        if frame < 44:
            (results / f"{frame:06d}.txt").write_text(CAR.format(alpha=0, z=15) + f" {frame}\n")
    return str(labels), str(results.parent)


def rows(text: str, start: str) -> list[list[str]]:
    return [row.split() for row in text.splitlines() if row.startswith(start)]


def test_tables(folders: tuple[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    """44 of 45 are found, thresholds at 40 of 41 recall points: 11 of 11 less the last, 39 of 40."""
    assert main(["evaluate", "--labels", folders[0], "--results", folders[1]]) == 0
    text = capsys.readouterr().out
    assert text.startswith("Car: 44 detections in 45 frames; labels: 45 easy, 45 moderate, 45 hard\n")
    assert "1 frames have no result file: their labels count as missed" in text
    header = "in percent IoU > AP_R11 easy AP_R11 moderate AP_R11 hard AP_R40 easy AP_R40 moderate AP_R40 hard"
    assert rows(text, "in percent") == [header.split()]
    assert rows(text, "3D box") == [["3D", "box", iou, *["90.91"] * 3, *["97.50"] * 3] for iou in ("0.7", "0.5")]
    assert "AOS_R40 moderate" in text


def test_few_labels_are_said_and_the_area_is_given(
    folders: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "two.txt").write_text("000003\n000044\n")
    assert (
        main(["evaluate", "--labels", folders[0], "--results", folders[1], "--split", str(tmp_path / "two.txt")]) == 0
    )
    text = capsys.readouterr().out
    assert "fewer than 41 labels cannot reach all recall points" in text
    assert "43 result files belong to no evaluated frame" in text
    assert rows(text, "3D box")[0][2:] == ["0.7", *["9.09"] * 3, *["0.00"] * 3, *["50.00"] * 3]


def test_json(folders: tuple[str, str], tmp_path: Path) -> None:
    path = tmp_path / "scores.json"
    assert main(["evaluate", "--labels", folders[0], "--results", folders[1], "--json", str(path)]) == 0
    content = json.loads(path.read_text())
    assert (content["schema_version"], content["num_frames"], content["num_frames_without_results"]) == (1, 45, 1)
    assert len(content["scores"]) == 18
    first = content["scores"][0]
    assert (first["metric"], first["minimum_iou"], first["difficulty"], first["num_labels"]) == ("2d", 0.7, "easy", 45)
    assert first["aos_r40"] == pytest.approx(97.5)
    assert len(first["precision"]) == len(first["orientation"]) == 41
    assert len(first["thresholds"]) == len(first["recall"]) == 40
    text = (Path(__file__).parents[2] / "docs" / "file_formats.md").read_text(encoding="utf-8")
    documented = text[text.index("- **`evaluate --json") : text.index("- **`evaluate-shape --json")]
    for name in (*content, *content["scores"][0]):
        assert name == "schema_version" or f"`{name}`" in documented


def test_detectors_of_image_boxes_alone(
    folders: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    results = tmp_path / "flat"
    results.mkdir()
    (results / "000000.txt").write_text("Car -1 -1 -10 100 100 200 150 -1 -1 -1 -1000 -1000 -1000 -10 0.9\n")
    assert main(["evaluate", "--labels", folders[0], "--results", str(results)]) == 0
    text = capsys.readouterr().out
    assert "no detection has a 3D box: image boxes alone are scored" in text
    assert rows(text, "2D box")
    assert not rows(text, "3D box")
    assert "orientation" not in text
