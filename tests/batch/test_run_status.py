"""What a run tells of itself, from the files that it leaves at each moment."""

from __future__ import annotations

import json
import platform
from dataclasses import replace
from pathlib import Path

import pytest

from directshape_torch.batch.journal import FrameRecord, Journal, JournalContents, journal_folder
from directshape_torch.batch.run_file import RunFile, read_run_file, run_path
from directshape_torch.batch.run_lock import RunLock, lock_path
from directshape_torch.batch.run_status import RunStatus, format_status, read_status
from directshape_torch.cli.main import main
from directshape_torch.errors import DataFormatError

WORK = {"where": "processes", "workers": 3, "threads": 1, "batch_frames": 2, "device": "cpu"}
TODO = tuple(f"{number:06d}" for number in range(10, 20))


def run_file(state: str = "running") -> RunFile:
    """Twelve frames, two of them of an earlier run; begun at second 1000."""
    run = RunFile("r1", "checking", 990.0, {"torch": "2.13.0"}, "Linux x86_64", {"config": {}}, WORK, 12)
    return run if state == "checking" else replace(run.refining(2, TODO), refining_since=1000.0)


def journal(out: Path, times: list[float], run_id: str = "r1", failed: str = "") -> None:
    for frame_id, time in zip(TODO, times, strict=False):
        entry = {"state": "failed", "reason": "cut short"} if frame_id == failed else {"state": "done"}
        Journal(out, run_id).add(FrameRecord(frame_id, {}, entry, time))


def status_of(out: Path, now: float) -> RunStatus:
    with RunLock(out):
        return read_status(out, now)


def test_done_failed_left_rate_and_time(tmp_path: Path) -> None:
    run_file().write(tmp_path)
    journal(tmp_path, [1002.0, 1004.0, 1006.0, 1008.0], failed=TODO[1])
    journal(tmp_path, [1.0] * 10, run_id="another")
    status = status_of(tmp_path, now=1009.0)
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
    run_file().write(tmp_path)
    journal(tmp_path, [1002.0, 1004.0, 1006.0, 1008.0])
    rates = [status_of(tmp_path, now).frames_per_s for now in (1008.0, 1010.0, 1020.0, 1108.0)]
    assert rates == pytest.approx([0.5, 0.5, 4 / 18, 4 / 106])


def test_a_line_that_is_being_written_is_not_yet_there(tmp_path: Path) -> None:
    run_file().write(tmp_path)
    journal(tmp_path, [1002.0, 1004.0])
    path = next(iter(journal_folder(tmp_path).iterdir()))
    path.write_bytes(path.read_bytes()[:-7])
    before = {file: file.stat().st_mtime_ns for file in tmp_path.rglob("*") if file.is_file()}
    status = status_of(tmp_path, 1005.0)
    assert (status.num_done, status.num_left, status.num_damaged_lines) == (3, 9, 1)
    after = {file: file.stat().st_mtime_ns for file in tmp_path.rglob("*") if file.is_file()}
    assert after == before, "a status only reads"


def test_states(tmp_path: Path) -> None:
    run_file("checking").write(tmp_path)
    assert status_of(tmp_path, 1000.0).state == "checking"
    assert read_status(tmp_path).state == "killed"
    run_file().write(tmp_path)
    assert status_of(tmp_path, 1000.0).state == "running"
    lock_path(tmp_path).write_text(json.dumps({"host": platform.node(), "pid": 2**22 + 1, "started_at": 1.0}))
    assert read_status(tmp_path).state == "killed"
    # Of another machine nobody here can tell.
    lock_path(tmp_path).write_text(json.dumps({"host": "elsewhere", "pid": 1, "started_at": 1.0}))
    assert read_status(tmp_path).state == "running"
    run_file().ended(10, {"000011": "cut short", "000012": "cut short"}, None).write(tmp_path)
    status = read_status(tmp_path)
    assert (status.state, status.num_done, len(status.failed), status.num_left) == ("finished", 10, 2, 0)
    run_file().ended(7, {}, "the disk is full").write(tmp_path)
    assert "stopped: the disk is full; the same command again goes on" in format_status(read_status(tmp_path))


def test_a_run_that_ends_while_it_is_asked_is_not_taken_for_killed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def ends(out: Path, _: str) -> JournalContents:
        run_file().ended(12, {}, None).write(out)
        return JournalContents([], 0)

    run_file().write(tmp_path)
    monkeypatch.setattr("directshape_torch.batch.run_status.read_journals", ends)
    status = read_status(tmp_path)
    assert (status.state, status.num_done, status.num_left) == ("finished", 12, 0)


def test_many_failures_are_counted_and_few_shown(tmp_path: Path) -> None:
    failed = {f"{number:06d}": "cut short" for number in range(30)}
    replace(run_file(), num_frames=30).ended(0, failed, None).write(tmp_path)
    lines = format_status(read_status(tmp_path), num_failures=4).splitlines()
    assert [line for line in lines if line.startswith("failed")][3:] == [
        "failed   000003: cut short",
        "failed   .. and 26 more",
    ]


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["status", str(tmp_path)]) == 2
    assert "no run of 'directshape refine' is or was here" in capsys.readouterr().err
    run_file().ended(11, {"000011": "cut short"}, None).write(tmp_path)
    assert main(["status", str(tmp_path)]) == 0
    assert "11 of 12 done" in capsys.readouterr().out
    assert main(["status", str(tmp_path), "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert (content["num_done"], content["num_left"], content["failed"]) == (11, 0, {"000011": "cut short"})


def test_a_run_file_comes_back(tmp_path: Path) -> None:
    assert read_run_file(tmp_path) is None
    run_file().write(tmp_path)
    found = read_run_file(tmp_path)
    assert found == replace(run_file(), todo=list(TODO))
    for content, problem in (
        ("[]", "describes no run"),
        ('{"schema_version": 7}', "schema version is 7"),
        ("{", "is not valid JSON"),
    ):
        run_path(tmp_path).write_text(content)
        with pytest.raises(DataFormatError, match=problem):
            read_run_file(tmp_path)
