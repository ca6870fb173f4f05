"""The example runs, and gives what the batch program gives for the same frame."""

from __future__ import annotations

import runpy
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from directshape_torch import DirectShapeRefiner
from directshape_torch.cli.demo import demo_dataset

EXAMPLE = Path(__file__).parent.parent.parent / "examples" / "behind_a_detector.py"


def test_example_gives_what_the_batch_program_gives(capsys: pytest.CaptureFixture[str]) -> None:
    found, result = runpy.run_path(str(EXAMPLE))["main"]()
    assert capsys.readouterr().out.count("\ncar ") == len(found.score) - 1
    loaded = demo_dataset().load("000000")
    # The example knows no instances but the detector's own.
    expected = DirectShapeRefiner()(loaded.frame, replace(loaded.detections, occluders=None))
    assert result.status == expected.status
    # Projections rounded on their way through the example move a car of 13 m by up to a centimetre along its ray.
    torch.testing.assert_close(result.T_cam_obj, expected.T_cam_obj, atol=2e-2, rtol=0)
