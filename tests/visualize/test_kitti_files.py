"""KITTI's files of an export hold the boxes of the run."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from helpers.finished_run import FRAMES, FinishedRun

from directshape_torch.visualize.export_run import export_run


@pytest.fixture(scope="module")
def exported(finished: FinishedRun, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("boxes")
    export_run(finished.inputs(), folder, ["kitti"])
    return folder


def test_kitti_text_is_copied_byte_for_byte(finished: FinishedRun, exported: Path) -> None:
    for frame_id in FRAMES:
        name = f"data/{frame_id}.txt"
        assert (exported / "kitti" / name).read_bytes() == (finished.out / name).read_bytes()


def test_kitti_json_says_what_the_lines_and_the_npz_say(finished: FinishedRun, exported: Path) -> None:
    content = json.loads((exported / "kitti" / "json" / "000001.json").read_text())
    state = finished.state("000001")
    lines = (finished.out / "data" / "000001.txt").read_text().splitlines()
    assert [one["status"] for one in content["objects"]] == [state["statuses"][0], "copied", state["statuses"][1]]
    for one, line in zip(content["objects"], lines, strict=True):
        words = line.split()
        columns = [one["truncated"], one["occluded"], one["alpha"], *one["bbox"], *one["dimensions_hwl"]]
        columns += [*one["location"], one["rotation_y"], one["score"]]
        assert one["type"] == words[0]
        assert columns == [float(word) for word in words[1:]]
    first = content["objects"][0]
    np.testing.assert_allclose(first["sigma_xyz_yaw"], state["sigmas_ref"][0])
    np.testing.assert_allclose(first["code"], state["codes"][0])
    for name in ("better", "not_worse"):
        np.testing.assert_allclose(first[f"probability_{name}"], state[f"probabilities_{name}"][0])
    assert first["probability_heading"] is None
    assert np.isnan(state["probabilities_heading"][0])
    np.testing.assert_allclose(first["location"], state["boxes_location_ref"][0], atol=1e-4)


def test_boxes_alone_need_no_images(finished: FinishedRun, exported: Path, tmp_path: Path) -> None:
    export_run(finished.inputs(with_images=False), tmp_path, ["kitti"])
    for name in ("data/000001.txt", "json/000001.json"):
        assert (tmp_path / "kitti" / name).read_bytes() == (exported / "kitti" / name).read_bytes()
