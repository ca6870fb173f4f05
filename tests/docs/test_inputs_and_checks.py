"""The documented layouts and findings are those of the code."""

from __future__ import annotations

import json
import re
from dataclasses import fields
from pathlib import Path
from typing import get_args

from directshape_torch.check.conventions import all_conventions
from directshape_torch.check.mistakes import MISTAKES, words_of_files
from directshape_torch.geometry.box_formats import box_form
from directshape_torch.io import folder_files
from directshape_torch.io.stereo_dataset import LayoutName

ROOT = Path(__file__).parents[2]
INPUTS = (ROOT / "docs" / "inputs.md").read_text(encoding="utf-8")
FOLDER = (ROOT / "docs" / "plain_folder.md").read_text(encoding="utf-8")
CHECKS = (ROOT / "docs" / "check_data.md").read_text(encoding="utf-8")


def first_column(text: str) -> set[str]:
    """Words in code type in the first column of tables."""
    cells = [line.split("|")[1] for line in text.splitlines() if line.startswith("| `")]
    return {name for cell in cells for name in re.findall(r"`([a-zA-Z0-9_]+)`", cell)}


def test_every_layout_is_in_the_table() -> None:
    assert first_column(INPUTS) == set(get_args(LayoutName))


def test_keys_of_the_folder() -> None:
    documented = first_column(FOLDER)
    kinds = (folder_files.FolderRig, folder_files.FolderFrame, folder_files.FolderObject)
    keys = {field.name.replace("object_class", "class") for kind in kinds for field in fields(kind)}
    assert documented == keys - {"comment"} | {"schema_version"}


def test_the_smallest_frame_is_one(tmp_path: Path) -> None:
    (example,) = re.findall(r"```json\n(.*?)```", FOLDER, flags=re.DOTALL)
    path = tmp_path / "000000.json"
    path.write_text(json.dumps(json.loads(example)))
    (car,) = folder_files.read_frame(path).objects
    assert car.bottom_center_m == [-3.2, 1.6, 14.0]


def test_every_finding_is_in_the_table() -> None:
    documented = first_column(CHECKS.split("## Findings")[1].split("## What it")[0])
    assert set(MISTAKES) | set(words_of_files(Path("calib.txt")).says) == documented
    camera, lidar = (len(all_conventions(box_form(name))) - 1 for name in ("kitti", "openpcdet"))
    assert f"in {camera} other ways (from a LiDAR's frame {lidar})" in CHECKS
