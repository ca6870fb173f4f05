"""The experiments: rows are valid settings, tables come out of a tiny data set, runs are kept, simulated AP is hit."""

from __future__ import annotations

import csv
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import reproduce_tables as script
import torch
from helpers.exact_disparity import exact_disparity
from helpers.kitti_folder import CODE, write_data_set
from helpers.synthetic_scene import TWO_CARS, street
from paper_tables import data_sets, tables, variants
from paper_tables.rows import GEOMETRIC, METHODS, ROWS, Settings

from directshape_torch.config_files import load_config
from directshape_torch.files.text_files import Line
from directshape_torch.io.disparity_files import write_disparity
from directshape_torch.io.kitti_labels import KittiObject, parse_object
from directshape_torch.refiner import DirectShapeRefiner


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A street in two frames, one of whose two cars is 25 px high; one detector named `data`, and true disparities."""
    root = tmp_path_factory.mktemp("street")
    frames = ("000000", "000001")
    prior = write_data_set(root, frames)
    scene = street(prior, *TWO_CARS, code=torch.tensor(CODE, dtype=prior.mean.dtype))
    for frame_id in frames:
        path = root / "training" / "disp_occ_0" / f"{frame_id}.png"
        write_disparity(path, exact_disparity(prior, scene)[0].numpy())
    return root


def _labels(num_frames: int = 20, cars_a_frame: int = 5) -> dict[str, list[KittiObject]]:
    """Visible cars of one size, 8 to 40 m away."""
    generator = np.random.default_rng(3)
    labels = {}
    for frame in range(num_frames):
        lines = []
        for car in range(cars_a_frame):
            x, z, yaw = 8.0 * (car - 2), generator.uniform(8, 40), generator.uniform(-3, 3)
            box = f"{100 + 200 * car} 100 {220 + 200 * car} 170"
            lines.append(f"Car 0.00 0 0.0 {box} 1.5 1.7 4.2 {x:.2f} 1.65 {z:.2f} {yaw:.2f}")
        labels[f"{frame:06d}"] = [parse_object("labels", Line(n, t, t)) for n, t in enumerate(lines, 1)]
    return labels


def test_every_row_is_a_valid_setting() -> None:
    rows = ROWS
    default = load_config()
    assert len({(row.group, row.name) for row in rows}) == len(rows)
    for row_settings in [*(row.settings for row in rows), *METHODS.values()]:
        load_config(row_settings.config, row_settings.all_overrides)
        config = load_config(row_settings.config, row_settings.overrides)
        # An override that changes nothing would make a row that says nothing.
        assert (config != default) == bool(row_settings.overrides or row_settings.config != "default"), row_settings
    assert sum(row.settings == replace(row.settings, overrides=()) for row in rows) > 5


def test_rows_that_ask_for_nothing_new_are_told_apart_by_prior_masks_field_or_start() -> None:
    rows = ROWS
    assert len({(row.settings, row.start) for row in rows}) == len(rows)


def test_exposures_by_hand() -> None:
    images = torch.tensor([0.0, 10.0, 120.0]).expand(1, 3, 2, 3) / 255
    assert torch.equal(variants.exposed(images, "true"), images)
    expected = {"flatter": [25.0, 33.0, 121.0], "vignetted": [0.0, 8.0, 78.0]}  # 10 * 0.825, 120 * 0.65
    for exposure, row in expected.items():
        torch.testing.assert_close(255 * variants.exposed(images, exposure)[0, 2, 1], torch.tensor(row))
    assert float(variants.exposed(torch.ones(1, 3, 1, 1), "flatter").max()) <= 1


def test_only_the_right_image_is_exposed_otherwise(data: Path) -> None:
    plain, other = (
        variants.ExposedDataset(data, data / "detections" / "data", exposure=e) for e in ("true", "flatter")
    )
    before, after = (dataset.load(dataset.frame_ids[0]).frame for dataset in (plain, other))
    assert torch.equal(before.images_left, after.images_left)
    assert torch.equal(variants.exposed(before.images_right, "flatter"), after.images_right)
    assert not torch.equal(before.images_right, after.images_right)


def test_no_noise_is_the_labels() -> None:
    labels = _labels(6)
    for frame_id, lines in variants.simulated_lines(labels, 0.0).items():
        found = {line.split()[4]: [float(word) for word in line.split()[11:15]] for line in lines}
        assert len(found) == 5
        for label in labels[frame_id]:
            x, y, z, yaw = found[f"{label.box_2d[0]:.4f}"]
            np.testing.assert_allclose([x, z, yaw], [*label.location_ref[::2], label.rotation_y], atol=1e-4)
            assert abs(y - label.location_ref[1]) < 4 * variants.VERTICAL_M


def test_noise_has_the_stated_size_and_does_not_depend_on_other_frames() -> None:
    labels = _labels(80)
    lines = variants.simulated_lines(labels, 2.0, seed=4)
    assert variants.simulated_lines({"000007": labels["000007"]}, 2.0, 4) == {"000007": lines["000007"]}
    truth = {(f, f"{o.box_2d[0]:.4f}"): o for f, objects in labels.items() for o in objects}
    pairs = [(truth[f, line.split()[4]], line.split()) for f, found in lines.items() for line in found]
    height = np.array([float(words[12]) - o.location_ref[1] for o, words in pairs])
    yaw = np.array([np.remainder(float(words[14]) - o.rotation_y + np.pi, 2 * np.pi) - np.pi for o, words in pairs])
    along = []
    for o, words in pairs:
        ray = np.array([o.location_ref[0], o.location_ref[2]])
        along.append(np.array([float(words[11]), float(words[13])]) @ ray / (ray @ ray) - 1)
    # 400 cars: the standard deviation of a sample is known to 3.5 percent.
    assert np.std(height) == pytest.approx(variants.VERTICAL_M, rel=0.15)
    assert np.std(yaw) == pytest.approx(np.radians(2 * variants.YAW_DEG), rel=0.15)
    assert np.std(along) == pytest.approx(2 * variants.DEPTH_SHARE, rel=0.15)


def _rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_pose_table_and_that_runs_are_kept(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    few = {"ours": Settings(("stages=[{max_iterations: 2}]",)), "baseline": GEOMETRIC}
    monkeypatch.setattr(tables, "METHODS", few)
    words = ["pose", "--data", str(data), "--out", str(tmp_path), "--draws", "20", "--stereo-bias", "none"]
    assert script.main([*words, "--device", "cpu"]) == 0
    text = (tmp_path / "pose.md").read_text(encoding="utf-8")
    assert "| input |" in text
    assert "| baseline |" in text
    assert "2 detections of 2 physical cars" in text
    rows = _rows(tmp_path / "pose_ap.csv")
    assert {row["after"] for row in rows} == {"input", "ours", "baseline"}
    assert {row["labels"] for row in rows if row["difficulty"] == "hard"} == {"2"}
    # The two methods, and the default, whose masks say which cars count.
    assert len(list((tmp_path / "runs" / data.name / "data").iterdir())) == 3

    def refuse(*_arguments: object) -> None:
        raise AssertionError("refined again")

    monkeypatch.setattr(DirectShapeRefiner, "forward", refuse)
    assert script.main([*words, "--device", "cpu"]) == 0
    assert (tmp_path / "pose.md").read_text(encoding="utf-8") == text


def test_ablation_table(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    chosen = ("default settings, every result", "2D boxes for masks", "left image only", "degraded", "1 times")
    rows = tuple(row for row in ROWS if row.name in chosen)
    monkeypatch.setitem(script.TABLES, "ablation", lambda experiment: tables.make_ablation_table(experiment, rows))
    words = ["ablation", "--data", str(data), "--detections", "data", "--out", str(tmp_path), "--draws", "20"]
    assert script.main([*words, "--stereo-bias", "none", "--frames", "0", "--device", "cpu"]) == 0
    found = {row["row"]: row for row in _rows(tmp_path / "ablation_rows.csv")}
    # The street has no degraded masks: that row says nothing about it.
    assert found.keys() == set(chosen) - {"degraded"}
    assert found["default settings, every result"]["difference"] == ""
    reference = float(found["default settings, every result"]["bev_iou"])
    boxes = found["2D boxes for masks"]
    assert float(boxes["difference"]) == pytest.approx(float(boxes["bev_iou"]) - reference)
    assert float(found["default settings, every result"]["time_ratio"]) == 1.0


def test_wrong_input_names_the_cure(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("DIRECTSHAPE_DATA", raising=False)
    assert script.main(["pose", "--out", str(tmp_path)]) == 2
    assert "set DIRECTSHAPE_DATA" in capsys.readouterr().err
    assert script.main(["pose", "--data", str(tmp_path), "--out", str(tmp_path)]) == 2
    assert "detections/NAME/data" in capsys.readouterr().err
    assert script.main(["pose", "--data", str(data), "--sets", "kitti", "--out", str(tmp_path)]) == 2
    assert data.name in capsys.readouterr().err


def test_the_development_data_is_found() -> None:
    root = os.environ.get("DIRECTSHAPE_DATA")
    if root is None:
        pytest.skip("DIRECTSHAPE_DATA is not set")
    found = data_sets.find_data_sets(Path(root))
    assert set(found) >= {"rendered", "kitti"}
    assert found["rendered"].has_exact_truth
    assert found["rendered"].masks_degraded is not None
    tracks = found["kitti"].tracks
    assert tracks is not None
    assert len({identity.car for identity in tracks.identities.values()}) >= 3
