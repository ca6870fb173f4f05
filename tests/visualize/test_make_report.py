"""The file of a page has its data, says what is missing, and shows names as text."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.finished_run import FinishedRun, unpacked
from helpers.quick_runs import refine

from directshape_torch.errors import DataFormatError
from directshape_torch.evaluation.comparison import compare_results
from directshape_torch.io.result_files import read_shapes
from directshape_torch.io.run_folder import RunFolder
from directshape_torch.visualize.make_report import ReportOutcome, make_report
from directshape_torch.visualize.run_frames import RunInputs


def blocks(page: Path) -> dict[str, Any]:
    """The data of a page by name."""
    found = re.findall(r'<script type="application/json" id="data-([\w-]+)">(.*?)</script>', page.read_text("utf-8"))
    return {name: json.loads(text) for name, text in found}


@pytest.fixture(scope="module")
def outcome(finished: FinishedRun, tmp_path_factory: pytest.TempPathFactory) -> ReportOutcome:
    return make_report(finished.inputs(), tmp_path_factory.mktemp("page") / "page.html")


@pytest.fixture(scope="module")
def data(outcome: ReportOutcome) -> dict[str, Any]:
    return blocks(outcome.path)


def test_page_carries_every_part(outcome: ReportOutcome, data: dict[str, Any]) -> None:
    assert outcome.notes == ()
    assert data["run"]["notes"] == []
    assert outcome.num_bytes == outcome.path.stat().st_size
    assert (outcome.num_frames, outcome.num_detailed, outcome.num_cars) == (2, 2, 4)
    assert data["frames"] == {"ids": ["000000", "000001"], "detailed": [0, 1]}
    for number in range(2):
        assert all(set(car) == {"before", "after"} for car in data[f"thumbnails-{number}"])
        for car in data[f"maps-{number}"]:
            kinds = {f"{kind}_{name}" for kind in ("photometric", "silhouette") for name in ("before", "after")}
            assert set(car["pictures"]) == kinds
            assert all(url.startswith("data:image/webp;base64,") for url in car["pictures"].values())
        scene = data[f"scene-{number}"]
        assert scene["image"].startswith("data:image/webp;base64,")
        assert len(scene["cars"]) == len(scene["truth"]) == 2
        assert np.allclose(scene["ground"][:3], [0, -1, 0], atol=1e-5)
        assert scene["ground"][3] == pytest.approx(1.65, abs=1e-5)


def test_table_says_what_the_files_say(finished: FinishedRun, data: dict[str, Any]) -> None:
    rows = [dict(zip(data["cars"]["columns"], row, strict=True)) for row in data["cars"]["rows"]]
    shapes = read_shapes(finished.out / "shapes" / "000001.npz")
    last = [row for row in rows if row["frame"] == 1]
    assert [row["line"] for row in last] == shapes.input_lines.tolist() == [1, 3]
    assert [row["status"] for row in last] == list(shapes.statuses)
    assert [row["distance_m"] for row in last] == pytest.approx(shapes.T_cam_obj[:, 2, 3], abs=0.006)
    # The same errors as `directshape compare`, and the means over the same cars.
    compared = compare_results(finished.root / "training" / "label_2", finished.root / "detections", finished.out)
    by_car = {(car.frame_id, car.detection_line): car for car in compared.cars}
    assert by_car
    for row in rows:
        key = (data["frames"]["ids"][row["frame"]], row["line"])
        assert row["counts"] is (key in by_car)
        if key not in by_car:
            continue
        car = by_car[key]
        assert row["iou_before"] == pytest.approx(car.before.bev_iou, abs=1e-4)
        assert row["iou_after"] == pytest.approx(car.after.bev_iou, abs=1e-4)
        assert row["centre_after_m"] == pytest.approx(car.after.centre_m, abs=1e-4)
    assert data["run"]["errors"]["cars"] == len(compared.cars)
    worse = sum(car.after.bev_iou < car.before.bev_iou - 0.05 for car in compared.cars)
    assert data["run"]["errors"]["worse"] == worse
    assert data["run"]["errors"]["iou_after"] == pytest.approx(
        np.mean([car.after.bev_iou for car in compared.cars]), abs=1e-4
    )


def test_meshes_stand_on_the_page_where_their_boxes_are(data: dict[str, Any]) -> None:
    for car in data["scene-0"]["cars"]:
        vertices = unpacked(car["mesh"]["vertices"]).reshape(3, -1).T / 1000
        T = np.array(car["T_cam_obj"]).reshape(4, 4)
        vertices_cam = vertices @ T[:3, :3].T + T[:3, 3]
        corners = np.array(car["box_after"]).reshape(8, 3)
        assert np.linalg.norm(vertices_cam.mean(axis=0) - corners.mean(axis=0)) < 0.25
        faces = unpacked(car["mesh"]["faces"]).reshape(-1, 3)
        assert faces.min() == 0
        assert faces.max() == len(vertices) - 1


def test_without_the_prior_there_are_boxes_alone(finished: FinishedRun, tmp_path: Path) -> None:
    outcome = make_report(RunInputs(finished.folder()), tmp_path / "page.html")
    assert any("no residual maps and no shapes" in note for note in outcome.notes)
    for car in blocks(outcome.path)["scene-0"]["cars"]:
        assert car["mesh"] is None
        assert len(car["box_after"]) == 24


def test_without_inputs_the_page_says_so(finished: FinishedRun, tmp_path: Path) -> None:
    outcome = make_report(finished.inputs(with_images=False), tmp_path / "page.html")
    data = blocks(outcome.path)
    assert data["run"]["notes"] == list(outcome.notes)
    assert any("--data" in note for note in outcome.notes)
    assert any("--detections" in note for note in outcome.notes)
    assert data["thumbnails-0"] == [{}, {}]
    assert data["scene-0"]["image"] is None
    assert data["scene-0"]["cars"][0]["box_before"] is None
    assert len(data["scene-0"]["cars"][0]["box_after"]) == 24


def test_a_changed_image_is_not_used(finished: FinishedRun, tmp_path: Path) -> None:
    root = Path(shutil.copytree(finished.root, tmp_path / "kitti"))
    shutil.copy(root / "training/image_3/000000.png", root / "training/image_2/000000.png")
    (root / "training/image_2/000001.png").unlink()
    (root / "masks/000001.json").unlink()
    outcome = make_report(FinishedRun(root, finished.out).inputs(), tmp_path / "page.html")
    data = blocks(outcome.path)
    assert data["scene-0"]["image"] is None
    assert "left image not used: the file has changed since the run (1 frame)" in outcome.notes
    assert "left image not found (1 frame)" in outcome.notes


def test_detections_are_looked_for_in_all_frames_and_images_where_there_are_pictures(
    finished: FinishedRun, tmp_path: Path
) -> None:
    root = Path(shutil.copytree(finished.root, tmp_path / "kitti"))
    for name in ("000000", "000001"):
        (root / "training" / "image_2" / f"{name}.png").unlink()
        path = root / "detections" / "data" / f"{name}.txt"
        path.write_text(path.read_text() + "\n")
    inputs = FinishedRun(root, finished.out).inputs()
    outcome = make_report(inputs, tmp_path / "page.html", most_frames=1)
    assert "left image not found (1 frame)" in outcome.notes
    of_detections = [note for note in outcome.notes if note.startswith("detections")]
    assert of_detections == ["detections not used: the file has changed since the run (2 frames)"]


def test_few_frames_have_details(finished: FinishedRun, tmp_path: Path) -> None:
    outcome = make_report(finished.inputs(), tmp_path / "page.html", most_frames=1)
    data = blocks(outcome.path)
    assert len(data["frames"]["detailed"]) == 1
    assert len(data["cars"]["rows"]) == 4
    assert sum(name.startswith("scene-") for name in data) == 1
    assert "pictures and 3D views of 1 of 2 frames (--max-frames)" in outcome.notes


def test_failed_frames_and_frames_without_cars(finished: FinishedRun, tmp_path: Path) -> None:
    root = Path(shutil.copytree(finished.root, tmp_path / "kitti"))
    (root / "training/image_3/000000.png").write_bytes(b"no image")
    (root / "detections/data/000001.txt").write_text("")
    refine(root, tmp_path / "out")
    again = FinishedRun(root, tmp_path / "out")
    data = blocks(make_report(again.inputs(), tmp_path / "page.html").path)
    assert list(data["run"]["failed"]) == ["000000"]
    assert data["frames"]["ids"] == ["000001"]
    assert data["cars"]["rows"] == []
    assert data["scene-0"]["cars"] == []
    assert data["run"]["errors"] is None


def test_a_run_that_was_cut_off(finished: FinishedRun, tmp_path: Path) -> None:
    out = Path(shutil.copytree(finished.out, tmp_path / "out"))
    text = (out / "data" / "000001.txt").read_bytes()
    (out / "data" / "000001.txt").unlink()
    cut_off = make_report(finished.inputs(RunFolder(out)), tmp_path / "a.html")
    assert blocks(cut_off.path)["frames"]["ids"] == ["000000"]
    (out / "data" / "000001.txt").write_bytes(text)
    # The run has a third frame to do.
    summary = json.loads((out / "summary.json").read_text())
    summary["frames"].append("000002")
    (out / "summary.json").write_text(json.dumps(summary))
    outcome = make_report(finished.inputs(RunFolder(out)), tmp_path / "b.html")
    assert blocks(outcome.path)["frames"]["ids"] == ["000000", "000001"]
    assert blocks(outcome.path)["run"]["ground_sources"] == {"file": 2}
    (note,) = outcome.notes
    assert re.search(r"not finished \(1 frames left\)", note)


def test_equal_runs_give_equal_pages(finished: FinishedRun, outcome: ReportOutcome, tmp_path: Path) -> None:
    again = make_report(finished.inputs(), tmp_path / "again.html")
    assert again.path.read_bytes() == outcome.path.read_bytes()


def test_a_damaged_frame_leaves_the_old_page(finished: FinishedRun, tmp_path: Path) -> None:
    out = Path(shutil.copytree(finished.out, tmp_path / "out"))
    page = tmp_path / "page.html"
    page.write_text("old")
    (out / "shapes" / "000001.npz").write_bytes(b"PK")
    with pytest.raises(DataFormatError, match="000001"):
        make_report(finished.inputs(RunFolder(out)), page)
    assert page.read_text() == "old"
    assert [path.name for path in tmp_path.iterdir() if path.name.endswith(".tmp")] == []
