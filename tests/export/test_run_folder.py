"""These tests check what exports read of a run."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers.finished_run import FinishedRun

from directshape_torch.errors import DataFormatError
from directshape_torch.io.run_folder import COPIED, RunFolder
from directshape_torch.status import Status


def test_objects_are_the_lines_with_boxes(finished: FinishedRun) -> None:
    frame = finished.folder().read("000000")
    assert [one.line.type for one in frame.objects] == ["Car", "Pedestrian", "Car"]
    assert [one.car for one in frame.objects] == [0, -1, 1]
    assert frame.objects[1].status == COPIED
    assert [one.line.line_number for one in frame.refined_cars] == [
        line for line, status in zip((1, 3), frame.shapes.statuses, strict=True) if Status[status].is_refined
    ]
    for one in frame.objects:
        np.testing.assert_allclose(one.R_ref_obj @ one.R_ref_obj.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(one.R_ref_obj) == pytest.approx(1)


def test_the_centre_is_half_a_height_above_the_bottom(finished: FinishedRun) -> None:
    pedestrian = finished.folder().read("000000").objects[1]
    # Pedestrian .. 1.80 0.60 0.60 -4.00 1.65 9.00 0.10, and y points down.
    np.testing.assert_allclose(pedestrian.centre_ref, [-4.0, 0.75, 9.0], atol=1e-12)
    np.testing.assert_allclose(pedestrian.R_ref_obj[:, 0], [np.cos(0.1), 0, -np.sin(0.1)], atol=1e-12)


def test_files_that_do_not_fit_together_are_named(finished: FinishedRun, tmp_path: Path) -> None:
    out = Path(shutil.copytree(finished.out, tmp_path / "out"))
    result = out / "data" / "000000.txt"
    result.write_text("".join(result.read_text().splitlines(keepends=True)[:1]))
    with pytest.raises(DataFormatError, match=r"data/000000.txt: has been changed, or does not belong to .*npz"):
        RunFolder(out).read("000000")
