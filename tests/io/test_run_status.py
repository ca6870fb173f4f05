"""The status of a run follows from the log at each moment."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from directshape_torch.cli.main import main
from directshape_torch.io.run_log import RunBeginning, RunLog, log_path
from directshape_torch.io.run_status import format_status, read_status

WORK = {"where": "processes", "workers": 3, "threads": 1, "batch_frames": 2, "device": "cpu"}
TODO = tuple(f"{number:06d}" for number in range(10, 20))


def begun(out: Path, *lines: Mapping[str, Any], num_frames: int = 12, **changes: Any) -> None:
    """A run of twelve frames, two of them from an earlier run, that refines since second 1000."""
    with RunLog(out) as log:
        log.begin(RunBeginning(WORK, num_frames, **{"started_at": 990.0, **changes}))
    with log_path(out).open("a") as file:
        file.writelines(json.dumps(line) + "\n" for line in lines)


def frames(times: list[float], failed: str = "") -> list[dict[str, Any]]:
    """Lines of frames that ended at these times, after the line of the finished check."""
    ends = [
        {"frame": frame_id, "at": time, "failure": "cut short" if frame_id == failed else None}
        for frame_id, time in zip(TODO, times, strict=False)
    ]
    return [{"resumed": 2, "at": 1000.0}, *ends]


def end(done: int, failed: Mapping[str, str], reason: str | None = None) -> dict[str, Any]:
    state = "finished" if reason is None else "stopped"
    return {"end": state, "at": 1100.0, "done": done, "failed": failed, "reason": reason}


def test_done_failed_left_rate_and_time(tmp_path: Path) -> None:
    begun(tmp_path, *frames([1002.0, 1004.0, 1006.0, 1008.0], failed=TODO[1]))
    status = read_status(tmp_path, now=1009.0)
    assert (status.num_done, status.num_left, status.failed) == (2 + 3, 6, {TODO[1]: "cut short"})
    # Four frames in eight seconds; six are left.
    assert status.frames_per_s == pytest.approx(0.5)
    assert status.seconds_left == pytest.approx(12.0)
    text = format_status(status, now=1009.0)
    assert "frames   5 of 12 done (2 of them in earlier runs), 1 failed, 6 left (50 %)" in text
    assert "rate     0.50 frames/s, about 0:00:12 left" in text
    assert "3 workers with 1 threads, processes" in text
    assert "latest   0:00:01 ago" in text
    assert f"failed   {TODO[1]}: cut short" in text


def test_a_run_that_is_stuck_becomes_slower(tmp_path: Path) -> None:
    begun(tmp_path, *frames([1002.0, 1004.0, 1006.0, 1008.0]))
    rates = [read_status(tmp_path, now).frames_per_s for now in (1008.0, 1010.0, 1020.0, 1108.0)]
    assert rates == pytest.approx([0.5, 0.5, 4 / 18, 4 / 106])


def test_states(tmp_path: Path) -> None:
    begun(tmp_path)
    assert read_status(tmp_path, 1000.0).state == "checking"
    begun(tmp_path, *frames([]))
    assert read_status(tmp_path, 1000.0).state == "running"
    begun(tmp_path, *frames([]), pid=2**22 + 1)
    assert read_status(tmp_path).state == "killed"
    # Of another machine nobody here can tell.
    begun(tmp_path, *frames([]), host="elsewhere", pid=1)
    assert read_status(tmp_path).state == "running"
    begun(tmp_path, *frames([]), end(10, {"000011": "cut short", "000012": "cut short"}))
    status = read_status(tmp_path)
    assert (status.state, status.num_done, len(status.failed), status.num_left) == ("finished", 10, 2, 0)
    begun(tmp_path, *frames([]), end(7, {}, "the disk is full"))
    assert "stopped: the disk is full; the same command again goes on" in format_status(read_status(tmp_path))


def test_a_run_that_ends_while_it_is_asked_is_not_taken_for_killed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def ends(_: RunBeginning) -> bool:
        with log_path(tmp_path).open("a") as file:
            file.write(json.dumps(end(12, {})) + "\n")
        return False

    begun(tmp_path, *frames([]))
    monkeypatch.setattr(RunBeginning, "is_alive", property(ends))
    status = read_status(tmp_path)
    assert (status.state, status.num_done, status.num_left) == ("finished", 12, 0)


def test_many_failures_are_counted_and_few_shown(tmp_path: Path) -> None:
    begun(tmp_path, end(0, {f"{number:06d}": "cut short" for number in range(30)}), num_frames=30)
    lines = format_status(read_status(tmp_path)).splitlines()
    assert [line for line in lines if line.startswith("failed")][9:] == [
        "failed   000009: cut short",
        "failed   .. and 20 more",
    ]


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    begun(tmp_path, end(11, {"000011": "cut short"}))
    assert main(["status", str(tmp_path)]) == 0
    assert "11 of 12 done" in capsys.readouterr().out
    assert main(["status", str(tmp_path), "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert (content["num_done"], content["num_left"], content["failed"]) == (11, 0, {"000011": "cut short"})
