"""These tests run `directshape refine` with the presets that fit points, and `--disparity`, as a user types them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers.kitti_folder import CODE, input_options, write_data_set, write_disparity
from helpers.synthetic_scene import TWO_CARS, street

from directshape_torch.cli.main import main
from directshape_torch.io.result_files import read_shapes
from directshape_torch.io.run_folder import RunFolder
from directshape_torch.io.stereo_dataset import open_dataset

QUICK = ("--set", "point_cloud.min_points=50", "stages=[{max_iterations: 2}]")


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two frames and their exact disparity, one file with the name of KITTI Stereo 2015."""
    import torch

    root = tmp_path_factory.mktemp("kitti")
    prior = write_data_set(root, ("000000", "000001"))
    scene = street(prior, *TWO_CARS, code=torch.tensor(CODE, dtype=torch.float64))
    disparity = scene.disparity[0].numpy()
    for name in ("000000", "000001_10"):
        write_disparity(root / "disparity" / f"{name}.png", disparity)
    return root


def refine(root: Path, out: Path, *extra: str) -> int:
    return main(["refine", *input_options(root), "--out", str(out), *QUICK, *extra])


@pytest.mark.parametrize("preset", ["geometric", "combined"])
def test_a_preset_with_disparity_maps(source: Path, tmp_path: Path, preset: str) -> None:
    assert refine(source, tmp_path, "--config", preset, "--disparity", str(source / "disparity")) == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["config"]["refiner"]["point_cloud"]["weight"] == {"geometric": 300, "combined": 30}[preset]
    assert set(RunFolder(tmp_path).read("000001").record.inputs) >= {"disparity", "image_left"}
    for frame_id in ("000000", "000001"):
        shapes = read_shapes(tmp_path / "shapes" / f"{frame_id}.npz")
        assert "point_cloud" in shapes.term_names
        assert ("photometric" in shapes.term_names) == (preset == "combined")


def test_a_bad_map_fails_its_frame_alone(source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = Path(shutil.copytree(source / "disparity", tmp_path / "disparity"))
    write_disparity(folder / "000000.png", np.ones((9, 9)))
    out = tmp_path / "out"
    assert refine(source, out, "--config", "geometric", "--disparity", str(folder)) == 1
    assert "frame 000000 failed: " in (message := capsys.readouterr().err)
    assert "000000.png: has 9 x 9 pixels, the left image 160 x 120" in message
    assert (out / "data" / "000001.txt").is_file()


def test_frames_of_several_sizes_keep_their_maps(source: Path) -> None:
    from directshape_torch.io.frame_collation import collate

    dataset = open_dataset("kitti", source, source / "detections", source / "masks", disparity_dir=source / "disparity")
    loaded = [dataset.load(frame_id) for frame_id in dataset.frame_ids]
    together = collate(loaded)[0].disparity
    np.testing.assert_array_equal(together[1], loaded[1].frame.disparity[0])  # type: ignore[index]
    bare = open_dataset("kitti", source, source / "detections", source / "masks").load("000000")
    assert collate([bare])[0].disparity is None
    with pytest.raises(ValueError, match="loaded: expected frames with disparity, or frames without, got 1 of 2"):
        collate([bare, loaded[1]])
