"""Only one run at a time holds a folder, and its log can be read after a kill or a cut at any place."""

from __future__ import annotations

import errno
import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

from directshape_torch.errors import DataFormatError, RunInProgressError
from directshape_torch.io.run_log import OutputLostError, RunBeginning, RunEvent, RunLog, log_path, read_log
from directshape_torch.io.run_status import read_status

# Does not end by itself: holds the folder until it is killed.
HOLDER = """
import sys, time
from pathlib import Path
from directshape_torch.io.run_log import RunBeginning, RunLog
with RunLog(Path(sys.argv[1])) as log:
    log.begin(RunBeginning({}, 3))
    print("held", flush=True)
    time.sleep(600)
"""


def test_a_second_run_is_told_who_is_there_and_a_killed_one_holds_nothing(tmp_path: Path) -> None:
    holder = subprocess.Popen([sys.executable, "-c", HOLDER, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    try:
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(RunInProgressError, match=f"another run is writing here \\(process {holder.pid} on "):
            RunLog(tmp_path).__enter__()
        log = read_log(tmp_path)
        assert log[0].is_alive
    finally:
        holder.kill()
        holder.communicate()
    assert log[0].is_alive is False
    with RunLog(tmp_path) as mine:
        mine.begin(RunBeginning({}, 3))
        now = read_log(tmp_path)
        assert (now[0].pid, now[0].host) == (os.getpid(), platform.node())


def written(out: Path) -> bytes:
    """A log of three frames, one of which fails."""
    with RunLog(out) as log:
        log.begin(RunBeginning({"threads": 1}, 5))
        log.add(RunEvent(1.0, resumed=2))
        for frame_id, failure in (("000000", None), ("000001", "cut short"), ("000002", None)):
            log.add(RunEvent(2.0, frame=frame_id, failure=failure))
        log.add(RunEvent(3.0, end="finished", done=4, failed={"000001": "cut short"}))
    assert b'{"at": 2.0, "frame": "000000"}\n' in log_path(out).read_bytes()
    return log_path(out).read_bytes()


def test_a_log_cut_anywhere_says_what_its_whole_lines_say(tmp_path: Path) -> None:
    content = written(tmp_path)
    states: list[tuple[str, int] | None] = []
    for end in range(len(content) + 1):
        log_path(tmp_path).write_bytes(content[:end])
        status = None if read_log(tmp_path) is None else read_status(tmp_path)
        states.append(None if status is None else (status.state, status.num_done))
    in_order = list(dict.fromkeys(states))
    assert in_order == [None, ("checking", 0), ("running", 2), ("running", 3), ("running", 4), ("finished", 4)]
    assert read_status(tmp_path).failed == {"000001": "cut short"}


@pytest.mark.parametrize("line", ["7", "null", "[]", '"frame"', '{"frame": 7}', '{"resumed": null}', "{"])
def test_lines_that_no_run_has_written_count_for_nothing(tmp_path: Path, line: str) -> None:
    content = written(tmp_path)
    log_path(tmp_path).write_bytes(content + line.encode() + b"\n")
    assert read_status(tmp_path).num_done == 4


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        ("7", "describes no run"),
        ("[]\n", "describes no run"),
        ('{"schema": "directshape run", "schema_version": 7}\n', "schema version is 7"),
        ('{"schema": "directshape run", "schema_version": 1}\n', "is missing"),
    ],
)
def test_files_of_other_programs_stay(tmp_path: Path, content: str, problem: str) -> None:
    log_path(tmp_path).write_text(content)
    with pytest.raises(DataFormatError, match=problem):
        RunLog(tmp_path).__enter__()
    assert log_path(tmp_path).read_text() == content


def test_a_folder_whose_place_a_file_takes_holds_nothing(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with RunLog(out):
        log_path(out).unlink()
        out.rmdir()
        out.write_text("a file")
    out.unlink()
    with RunLog(out):
        assert log_path(out).exists()


def test_what_a_full_disk_took_of_a_line_is_taken_back(tmp_path: Path) -> None:
    class Disk:
        """Take ten bytes and fail."""

        def __init__(self, file: object) -> None:
            self.file, self.left = file, 10

        def write(self, content: memoryview) -> int:
            if not self.left:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            taken, self.left = self.left, 0
            return int(self.file.write(content[:taken]))  # type: ignore[attr-defined]

        def __getattr__(self, name: str) -> object:
            return getattr(self.file, name)

    with RunLog(tmp_path) as log:
        log.begin(RunBeginning({}, 5))
        whole, file = log_path(tmp_path).read_bytes(), log._file
        log._file = Disk(file)  # type: ignore[assignment]
        with pytest.raises(OutputLostError, match=r"No space left.*run the same command again"):
            log.add(RunEvent(1.0, resumed=2))
        assert log_path(tmp_path).read_bytes() == whole
        log._file = file
        log.add(RunEvent(1.0, resumed=2))
    found = read_log(tmp_path)
    assert [event.resumed for event in found[1]] == [2]
