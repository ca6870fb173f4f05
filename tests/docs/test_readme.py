"""The README's Python runs unchanged, and its commands are those of CI."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch

from directshape_torch.cli.demo import demo_dataset
from directshape_torch.geometry.box_formats import poses_to_boxes

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def tensors_of_the_bundled_frame() -> dict[str, object]:
    """Outputs of a detector for the bundled frame, by the names of the README."""
    loaded = demo_dataset().load("000000")
    frame, found = loaded.frame, loaded.detections
    return {
        "K": frame.camera.K_left[0],
        "baseline_m": float(frame.camera.baseline),
        "images_left": frame.images_left,
        "images_right": frame.images_right,
        "boxes_3d": poses_to_boxes(found.T_cam_obj, found.dimensions_hwl, "kitti"),
        "masks_left": found.mask_left.dense(),
        "masks_right": found.mask_right.dense(),
        "frame_index": found.frame_index,
    }


@pytest.mark.parametrize("with_boxes", [False, True], ids=["masks alone", "boxes"])
def test_a_dozen_lines_refine_tensors(with_boxes: bool) -> None:
    code, boxes = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    if with_boxes:
        code = re.sub(r"cars = .*\n", boxes, code)
    names = tensors_of_the_bundled_frame()

    exec(compile(code, "README.md", "exec"), names)

    result = names["result"]
    assert names["refined"].shape == (6, 7)
    assert names["spread"].shape == (6, 4)
    assert len(names["surfaces"]) == 6
    assert sum(status.is_refined for status in result.status) >= 4
    assert bool((torch.nan_to_num(result.quality.mask_iou_left) > 0.85).all())
    assert sum(bool(line) for line in code.splitlines()) <= 12


@pytest.mark.parametrize("name", ["demo", "tests"])
def test_each_marked_command_is_one_shell_line(name: str) -> None:
    (command,) = re.findall(rf"<!-- command: {name} -->\n```bash\n(.*?)```", README, re.DOTALL)

    assert command.strip().count("\n") == 0
    assert command.startswith("python3 -m venv")


def test_every_figure_of_the_results_is_in_the_docs() -> None:
    table = README[README.index("## Results") : README.index("## Limits")]
    figures = re.findall(r"\b0\.\d{3}\b", table)
    known = "".join((ROOT / "docs" / name).read_text(encoding="utf-8") for name in ("results.md", "tracks_measured.md"))

    assert figures
    assert not [figure for figure in figures if figure not in known]
