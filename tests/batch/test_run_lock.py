"""One run at a time in a folder, whoever was killed there before."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

from directshape_torch.batch.run_lock import LockOwner, RunLock, lock_path, read_lock_owner
from directshape_torch.errors import RunInProgressError

# Does not end by itself: holds the lock until it is killed.
HOLDER = """
import sys, time
from pathlib import Path
from directshape_torch.batch.run_lock import RunLock
with RunLock(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(600)
"""


def test_a_second_run_is_told_who_is_there_and_a_killed_one_holds_nothing(tmp_path: Path) -> None:
    holder = subprocess.Popen([sys.executable, "-c", HOLDER, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    try:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(RunInProgressError, match=f"another run is writing here \\(process {holder.pid} on "):
            RunLock(tmp_path).__enter__()
        owner = read_lock_owner(tmp_path)
        assert owner is not None
        assert owner.is_alive
    finally:
        holder.kill()
        holder.communicate()
    assert owner.is_alive is False
    assert lock_path(tmp_path).exists()
    with RunLock(tmp_path):
        now = read_lock_owner(tmp_path)
        assert now is not None
        assert (now.pid, now.host) == (os.getpid(), platform.node())
    assert not lock_path(tmp_path).exists()


def test_within_one_process_too(tmp_path: Path) -> None:
    with RunLock(tmp_path / "new"):
        with pytest.raises(RunInProgressError):
            RunLock(tmp_path / "new").__enter__()
        assert read_lock_owner(tmp_path / "new") is not None
    with RunLock(tmp_path / "new"):
        pass


@pytest.mark.parametrize("content", ["", "{", "[1]", '{"host": "a"}'])
def test_an_owner_that_cannot_be_read_is_nobody(tmp_path: Path, content: str) -> None:
    lock_path(tmp_path).write_text(content)
    assert read_lock_owner(tmp_path) is None
    with RunLock(tmp_path):
        pass


def test_processes_of_other_machines_are_not_judged(tmp_path: Path) -> None:
    lock_path(tmp_path).write_text(json.dumps({"host": "elsewhere", "pid": 1, "started_at": 0.0}))
    owner = read_lock_owner(tmp_path)
    assert owner == LockOwner("elsewhere", 1, 0.0)
    assert owner is not None
    assert owner.is_alive is None


def test_a_folder_whose_place_a_file_takes_holds_nothing(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with RunLock(out) as lock:
        lock_path(out).unlink()
        out.rmdir()
        out.write_text("a file")
    assert lock._file is None
    out.unlink()
    with RunLock(out):
        assert lock_path(out).exists()


def test_a_full_disk_leaves_nothing_locked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr("json.dump", full)
        with pytest.raises(OSError, match="No space"):
            RunLock(tmp_path).__enter__()
    with RunLock(tmp_path):
        pass
