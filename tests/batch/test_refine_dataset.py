"""These tests check what a run writes from images to files, on a tiny data set."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.kitti_folder import CODE, FRAMES, PEDESTRIAN
from helpers.quick_runs import refine, result_files

from directshape_torch.io.kitti_labels import read_objects
from directshape_torch.io.result_files import read_shapes
from directshape_torch.visualize.overlay import overlay_of_frame


@pytest.fixture(scope="module")
def out(shared_kitti: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with all optional outputs."""
    out = tmp_path_factory.mktemp("out")
    refine(shared_kitti, out, draw=overlay_of_frame)
    return out


def test_lines_keep_their_order_and_other_classes_their_bytes(shared_kitti: Path, out: Path) -> None:
    lines = (out / "data" / "000000.txt").read_text().split("\n")
    given = (shared_kitti / "detections" / "data" / "000000.txt").read_text().split("\n")
    assert len(lines) == len(given) == 4
    assert lines[1] == PEDESTRIAN
    for refined, rough in ((lines[0], given[0]), (lines[2], given[2])):
        assert refined != rough
        new, old = refined.split(), rough.split()
        assert new[:3] + new[4:8] + new[15:] == old[:3] + old[4:8] + old[15:]


def test_shapes_hold_states_of_the_refined_lines(out: Path) -> None:
    shapes = read_shapes(out / "shapes" / "000001.npz")
    assert shapes.input_lines.tolist() == [1, 3]
    assert shapes.codes.shape == np.shape(CODE)
    assert shapes.ground_source == "file"
    assert np.isfinite(shapes.covariances).all()
    summary = json.loads((out / "summary.json").read_text())
    assert summary["sha256"]["prior"] == shapes.prior_sha256
    # The boxes of the lines, of which the second is a pedestrian's.
    for car, line in zip((0, 1), read_objects(out / "data" / "000001.txt")[::2], strict=True):
        assert line.hwl == pytest.approx(shapes.boxes_hwl[car], abs=1e-4)
        assert line.location_ref == pytest.approx(shapes.boxes_location_ref[car], abs=1e-4)
        assert line.rotation_y == pytest.approx(shapes.boxes_rotation_y[car], abs=1e-4)
        assert line.alpha == pytest.approx(
            line.rotation_y - np.arctan2(line.location_ref[0], line.location_ref[2]), abs=1e-3
        )


def test_equal_runs_write_equal_bytes(shared_kitti: Path, out: Path, tmp_path: Path) -> None:
    refine(shared_kitti, tmp_path, draw=overlay_of_frame)
    first = result_files(tmp_path)
    assert first == result_files(out)
    names = ("data/000000.txt", "shapes/000000.npz", "overlays/000000.png", "summary.json")
    assert set(names) <= set(first)
    picture = cv2.imdecode(np.frombuffer(first["overlays/000000.png"], np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape[1] > 1000


def test_frames_in_one_call_give_the_results_of_single_calls(shared_kitti: Path, out: Path, tmp_path: Path) -> None:
    refine(shared_kitti, tmp_path, batch_frames=2)
    for frame_id in FRAMES:
        single, together = (read_shapes(each / "shapes" / f"{frame_id}.npz") for each in (out, tmp_path))
        np.testing.assert_allclose(together.T_cam_obj, single.T_cam_obj, atol=2e-4)
        assert together.statuses == single.statuses
    calls = json.loads((tmp_path / "timings.json").read_text())["calls"]
    assert [call["frames"] for call in calls] == [["000000", "000001"], ["000002"]]


@pytest.mark.parametrize("content", ["", f"{PEDESTRIAN}\n"])
def test_a_frame_without_cars_is_copied(kitti_copy: Path, tmp_path: Path, content: str) -> None:
    for frame_id in FRAMES:
        (kitti_copy / "detections" / "data" / f"{frame_id}.txt").write_text(content)
    summary = refine(kitti_copy, tmp_path, draw=overlay_of_frame)
    assert summary.exit_code == 0
    assert summary.num_cars == 0
    assert (tmp_path / "data" / "000000.txt").read_text() == content
    assert read_shapes(tmp_path / "shapes" / "000000.npz").T_cam_obj.shape == (0, 4, 4)
    assert len(summary.warnings) == (1 if content else 0)


def test_cars_without_masks_stay_as_they_were_and_a_warning_says_so(kitti_copy: Path, tmp_path: Path) -> None:
    for frame_id in FRAMES:
        (kitti_copy / "masks" / f"{frame_id}.json").write_text("[]")
    summary = refine(kitti_copy, tmp_path)
    assert summary.statuses == {"no_mask": 2 * len(FRAMES)}
    assert any("none of the 6 cars has a mask" in warning for warning in summary.warnings)
    name = "data/000000.txt"
    assert (tmp_path / name).read_bytes() == (kitti_copy / "detections" / name).read_bytes()
