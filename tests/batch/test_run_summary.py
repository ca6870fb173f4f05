"""These tests check the summary of a run: counts, warnings, exit code, times."""

from __future__ import annotations

import inspect
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from directshape_torch.batch.run_summary import (
    CallTiming,
    RunSummary,
    RunTimings,
    find_warnings,
    format_summary,
    peak_memory_mb,
)


def done(**statuses: int) -> dict[str, Any]:
    cars = sum(statuses.values())
    masks = {"masks_left": cars, "masks_right": cars}
    return {"lines": cars + 1, "cars": cars, "statuses": statuses, "ground_source": "file", **masks}


FAILED = {"reason": "cut short"}


def timings() -> RunTimings:
    calls = [CallTiming(("000000",), 2, 0.3), CallTiming(("000001", "000002"), 4, 0.6)]
    return RunTimings(torch.device("cpu"), calls)


@pytest.mark.parametrize(
    ("frames", "expected"),
    [
        ({"a": done(converged=3)}, []),
        ({"a": FAILED}, []),
        ({"a": done(no_mask=2), "b": done(no_mask=1)}, ["none of the 3 cars has a mask"]),
        ({"a": done(behind_camera=2)}, ["all 2 initial boxes lie behind"]),
        ({"a": done(converged=1, too_few_pixels=2)}, ["only 1 of 3 cars were refined"]),
        ({"a": done()}, ["none of the 1 input lines is of class Car"]),
        ({"a": done(converged=1) | {"masks_right": 0}, "b": done(converged=1)}, []),
        ({"a": done(converged=1) | {"masks_right": 0}}, []),
        (
            {"a": done(converged=1, no_mask=1) | {"no_mask": {"2": "its entry has no mask"}}},
            ["1 of 2 cars have no mask in the left image: line 2 of a: its entry has no mask"],
        ),
        ({"a": done(converged=1) | {"ground_source": "camera_height"}}, ["the ground of 1 of 1 frames"]),
    ],
)
def test_warnings(frames: dict[str, Any], expected: list[str]) -> None:
    found = find_warnings(frames, ["Car"])
    assert len(found) == len(expected)
    for warning, start in zip(found, expected, strict=True):
        assert warning.startswith(start)


def test_report() -> None:
    frames = {"000000": done(converged=2), "000001": done(converged=3, no_mask=1), "000002": FAILED}
    summary = RunSummary(frames, ("000000",), {"000002": "cut short"}, (), timings())
    assert summary.exit_code == 1
    assert summary.num_cars == 6
    lines = format_summary(summary).splitlines()
    assert lines[0] == "frames   2 done, 1 of them in an earlier run, 1 failed"
    assert lines[1] == "cars     6: 5 refined (converged 5), 1 as before (no_mask 1)"
    # 0.9 s over 6 cars and 3 frames.
    assert lines[2] == "time     150 ms per car, 300 ms per frame (refinement only, cpu)"
    assert lines[3].startswith("memory   ")


def test_the_rate_says_what_share_of_the_time_is_refinement() -> None:
    """0.9 s of calls in three seconds of two workers."""
    of_run = replace(timings(), wall_s=3.0, workers=2)
    lines = format_summary(RunSummary({}, (), {}, (), of_run)).splitlines()
    assert "rate     1.00 frames a second by 2 workers, of whose time 15% is refinement" in lines


def test_a_run_without_work_has_no_time() -> None:
    nothing = RunTimings(torch.device("cpu"))
    assert "time" not in format_summary(RunSummary({}, (), {}, (), nothing))


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="of Linux")
def test_peak_memory_is_not_that_of_the_process_that_started_this_one() -> None:
    # Loaded by itself: the package brings PyTorch, and the peak of that is as large as the ballast may be.
    source = inspect.getsource(peak_memory_mb).replace("-> float | None", "")
    code = f"import sys\nfrom pathlib import Path\n{source}\nprint(peak_memory_mb())"
    ballast = bytearray(200_000_000)
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert len(ballast) > 2**20 * float(printed)
