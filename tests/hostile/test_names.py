"""Frame names with any content cannot write or replace files outside the output folder."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
from helpers.quick_runs import dataset, refine, refiner

from directshape_torch.batch.refine_dataset import refine_dataset
from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.io.instance_masks import InstanceMask, within_memory
from directshape_torch.visualize.drawing import draw_text


@pytest.mark.parametrize("name", ["../foreign", "/tmp/foreign", "..", "a/b", "a\\b", "a\0b", "x" * 300, "\u202e"])
def test_lists_of_frames(shared_kitti: Path, tmp_path: Path, name: str) -> None:
    split = tmp_path / "split.txt"
    split.write_text(f"000000\n{name}\n")
    with pytest.raises(DataFormatError, match=r"split\.txt, line 2: names no frame of the data"):
        dataset(shared_kitti, split=split)


def test_a_file_whose_name_is_no_text(kitti_copy: Path) -> None:
    os.rename(kitti_copy / "detections" / "data" / "000001.txt", bytes(kitti_copy) + b"/detections/data/\xff1.txt")
    with pytest.raises(InputError, match="names without folders"):
        dataset(kitti_copy)
    assert dataset(kitti_copy, frames=["000000"]).frame_ids == ("000000",)
    draw_text(np.zeros((20, 20, 3), np.uint8), "\udcff", (1, 9))


def test_records_that_climb(shared_kitti: Path, tmp_path: Path) -> None:
    """A summary from elsewhere cannot make a run, a report or an export touch what lies outside."""
    out, foreign = tmp_path / "out", tmp_path / "foreign.txt"
    refine(shared_kitti, out)
    foreign.write_text("mine")
    content = json.loads((out / "summary.json").read_text())
    content["frames"].append("../../foreign")
    (out / "summary.json").write_text(json.dumps(content))
    with pytest.raises(DataFormatError, match=r"summary\.json: .*frames.*foreign"):
        refine(shared_kitti, out)
    assert foreign.read_text() == "mine"


@pytest.mark.parametrize("name", ["data", "shapes", "overlays", "failed"])
def test_a_folder_of_results_that_is_a_link(shared_kitti: Path, tmp_path: Path, name: str) -> None:
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "000000.txt").write_text("mine")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / name).symlink_to(foreign)
    for fresh in (False, True):
        with pytest.raises(InputError, match=rf"out: expected folders of its own .*, got link .*{name}; remove the li"):
            refine_dataset(dataset(shared_kitti), refiner(shared_kitti), tmp_path / "out", fresh=fresh)
    assert [path.read_text() for path in foreign.iterdir()] == ["mine"]


def test_an_output_folder_that_is_a_link_is_the_user_s_own(shared_kitti: Path, tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    (tmp_path / "out").symlink_to(tmp_path / "disk")
    assert refine(shared_kitti, tmp_path / "out").exit_code == 0
    assert (tmp_path / "disk" / "summary.json").is_file()


def test_instances_of_an_image_fit_into_memory() -> None:
    small, whole = (InstanceMask("left", 1, True, (0, 0), np.ones(size, bool)) for size in ((30, 50), (375, 1242)))
    assert len(within_memory(Path("a.png"), [small, None] * 5000)) == 5000
    with pytest.raises(DataFormatError, match="the first 577 instances cover over 268435456 pixels; keep the likely"):
        within_memory(Path("a.png"), (whole for _ in range(65535)))
