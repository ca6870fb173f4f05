"""The status of a run follows from the files in its folder at each moment."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path

import pytest

from directshape_torch.cli.main import main
from directshape_torch.errors import DataFormatError
from directshape_torch.files.atomic_files import write_text
from directshape_torch.io.run_folder import failure_path, result_path, shapes_path, summary_path
from directshape_torch.io.run_manifest import RunManifest, write_manifest
from directshape_torch.io.run_status import format_status, read_status

TODO = tuple(f"{number:06d}" for number in range(10, 20))
EARLIER = ("000000", "000001")
LATER = "000002"


def begun(out: Path, times: Mapping[str, float], failed: Mapping[str, str] | None = None) -> None:
    """A run of twelve frames, two of them from an earlier run, that refines since second 1000."""
    write_manifest(summary_path(out), RunManifest("0", {}, {"prior": "a", "stereo_bias": None}, [*EARLIER, *TODO]))
    os.utime(summary_path(out), (1000.0, 1000.0))
    for name, at in {**dict.fromkeys(EARLIER, 900.0), **times}.items():
        for path in (result_path(out, name), shapes_path(out, name)):
            write_text(path, "")
            os.utime(path, (at, at))
    for name, reason in (failed or {}).items():
        write_text(failure_path(out, name), reason + "\n")


def in_order(*times: float) -> dict[str, float]:
    return dict(zip(TODO, times, strict=False))


def test_done_failed_left_rate_and_time(tmp_path: Path) -> None:
    begun(tmp_path, in_order(1002.0, 1004.0, 1006.0, 1008.0), {TODO[9]: "cut short"})
    status = read_status(tmp_path, now=1009.0)
    assert (status.num_done, status.num_left, status.failed) == (2 + 4, 5, {TODO[9]: "cut short"})
    # Four frames in eight seconds; five are left.
    assert status.frames_per_s == pytest.approx(0.5)
    assert status.seconds_left == pytest.approx(10.0)
    text = format_status(status, now=1009.0)
    assert "frames   6 of 12 done (2 of them earlier), 1 failed, 5 left (58 %)" in text
    assert "rate     0.50 frames/s, about 0:00:10 left" in text
    assert "latest   0:00:01 ago" in text
    assert f"failed   {TODO[9]}: cut short" in text


def test_a_run_that_is_stuck_becomes_slower(tmp_path: Path) -> None:
    begun(tmp_path, in_order(1002.0, 1004.0, 1006.0, 1008.0))
    rates = [read_status(tmp_path, now).frames_per_s for now in (1008.0, 1010.0, 1020.0, 1108.0)]
    assert rates == pytest.approx([0.5, 0.5, 4 / 18, 4 / 106])


def test_what_counts_as_done(tmp_path: Path) -> None:
    # The second is no frame of the data set, and the third has only one of its files.
    begun(tmp_path, {TODO[0]: 1001.0, LATER: 1001.0, TODO[3]: 1001.0}, {TODO[0]: "of another run"})
    result_path(tmp_path, TODO[3]).unlink()
    status = read_status(tmp_path, 1002.0)
    assert (status.num_done, status.num_earlier, status.failed, status.num_left) == (3, 2, {}, 9)


def test_a_run_that_has_ended_has_no_rate(tmp_path: Path) -> None:
    begun(tmp_path, dict.fromkeys(TODO, 1005.0))
    status = read_status(tmp_path, 2000.0)
    assert (status.num_left, status.frames_per_s, status.seconds_left) == (0, None, None)
    assert format_status(status, 2000.0) == "frames   12 of 12 done, 0 failed, 0 left (100 %)"


def test_many_failures_are_counted_and_few_shown(tmp_path: Path) -> None:
    begun(tmp_path, {}, dict.fromkeys(TODO, "cut short"))
    for name in EARLIER:
        shapes_path(tmp_path, name).unlink()
        write_text(failure_path(tmp_path, name), "cut short")
    lines = format_status(read_status(tmp_path)).splitlines()
    assert [line for line in lines if line.startswith("failed")][9:] == [
        "failed   000017: cut short",
        "failed   .. and 2 more",
    ]


def test_a_folder_without_a_run(tmp_path: Path) -> None:
    with pytest.raises(DataFormatError, match=r"summary\.json: is missing, so no run of 'directshape refine'"):
        read_status(tmp_path)


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    begun(tmp_path, dict.fromkeys(TODO[:9], 1001.0), {TODO[9]: "cut short"})
    assert main(["status", str(tmp_path)]) == 0
    assert "11 of 12 done" in capsys.readouterr().out
    assert main(["status", str(tmp_path), "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert (content["num_done"], content["num_left"], content["failed"]) == (11, 0, {TODO[9]: "cut short"})
