"""The examples of the guide run, and give what they promise."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import pytest
import torch

from directshape_torch import DirectShapeRefiner, PCAShapePrior
from directshape_torch.cli.demo import demo_dataset
from directshape_torch.status import Status

EXAMPLES = Path(__file__).parents[2] / "examples"


def example(name: str) -> dict[str, Any]:
    return runpy.run_path(str(EXAMPLES / f"{name}.py"))


def test_kitti_files_gives_a_line_for_each_car(tmp_path: Path) -> None:
    lines = example("kitti_files")["main"](tmp_path)
    assert [line.split(":")[0] for line in lines] == [f"line {number}" for number in range(1, 7)]
    assert (tmp_path / "data" / "000000.txt").is_file()


def test_coco_masks_are_matched_to_their_boxes(tmp_path: Path) -> None:
    result = example("coco_masks")["main"](tmp_path)
    loaded = demo_dataset().load("000000")
    expected = DirectShapeRefiner()(loaded.frame, loaded.detections)
    # The network of the example is less sure of its masks and knows only those of cars with boxes.
    torch.testing.assert_close(result.T_cam_obj, expected.T_cam_obj, atol=0.05, rtol=0)


def test_own_shapes_are_built_saved_and_used(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    result = example("own_shapes")["main"](tmp_path)
    assert capsys.readouterr().out.startswith("12 meshes, variance explained")
    assert isinstance(result.prior, PCAShapePrior)
    assert result.prior.provenance.num_samples == 12
    assert [status.is_refined for status in result.status].count(True) >= 5
    assert Status.singular not in result.status
