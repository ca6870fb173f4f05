"""Runs that are disturbed from outside end, and every frame has its files or a reported failure."""

from __future__ import annotations

import json
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
from helpers import quick_runs
from helpers.kitti_folder import FRAMES, input_options, write_data_set
from helpers.quick_runs import result_files

import directshape_torch
from directshape_torch.batch.options import RunObserver
from directshape_torch.errors import DataFormatError
from directshape_torch.io.result_files import read_shapes, write_shapes
from directshape_torch.io.run_folder import RunFolder, done_frames
from directshape_torch.io.run_status import read_status

refine = partial(quick_runs.refine, threads=1)


@pytest.fixture(scope="module")
def undisturbed(shared_kitti: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("undisturbed")
    refine(shared_kitti, out)
    return out


@pytest.mark.parametrize("delay_s", [0.0, pytest.param(0.7, marks=pytest.mark.long)])
def test_a_worker_that_is_killed_as_it_starts(
    shared_kitti: Path, tmp_path: Path, undisturbed: Path, delay_s: float
) -> None:
    """The worker dies before it has read the job, which is larger than a pipe holds."""
    killed: list[int] = []

    def kill() -> None:
        while not (found := multiprocessing.active_children()):
            time.sleep(0.01)
        time.sleep(delay_s)
        assert found[0].pid is not None
        killed.append(found[0].pid)
        os.kill(found[0].pid, signal.SIGKILL)

    killer = threading.Thread(target=kill, daemon=True)
    killer.start()
    summary = refine(shared_kitti, tmp_path / "out", workers=1)
    killer.join()
    assert (len(killed), summary.exit_code) == (1, 0)
    assert result_files(tmp_path / "out") == result_files(undisturbed)


class Mover(RunObserver):
    """A `Mover` renames the output folder after a frame has ended."""

    def __init__(self, out: Path, to: Path) -> None:
        self.out, self.to = out, to

    def finished(self, frame_id: str, failure: str | None) -> None:
        if not self.to.exists():
            os.rename(self.out, self.to)


def test_a_folder_that_is_moved_away_is_not_success(shared_kitti: Path, tmp_path: Path, undisturbed: Path) -> None:
    out, moved = tmp_path / "out", tmp_path / "moved"
    summary = refine(shared_kitti, out, observer=Mover(out, moved))
    assert summary.exit_code == 1
    assert list(summary.failed) == [FRAMES[0]]
    assert "was the folder moved or emptied during the run?" in summary.failed[FRAMES[0]]
    assert refine(shared_kitti, out).resumed == FRAMES[1:]
    assert result_files(out) == result_files(undisturbed)
    # What was moved is a run that was cut off, and the next one goes on with it.
    assert refine(shared_kitti, moved).exit_code == 0
    assert result_files(moved) == result_files(undisturbed)


class Thief(RunObserver):
    """A `Thief` removes a file of each frame that has ended."""

    def __init__(self, out: Path) -> None:
        self.out = out

    def finished(self, frame_id: str, failure: str | None) -> None:
        (self.out / "shapes" / f"{frame_id}.npz").unlink()


def test_files_that_vanish_during_the_run_are_missed(shared_kitti: Path, tmp_path: Path) -> None:
    summary = refine(shared_kitti, tmp_path, observer=Thief(tmp_path))
    assert (summary.exit_code, tuple(summary.failed)) == (1, FRAMES)
    assert read_status(tmp_path).num_done == 0


@pytest.mark.parametrize(
    "change",
    [
        {"run": "other"},
        {"run": 7},
        {"inputs": ["a"]},
        {"outputs": 5},
        {"files": {"../../foreign": "00"}},
        {"files": {}},
        {"more": 1},
        None,
    ],
    ids=str,
)
def test_frames_of_records_that_no_run_has_written(
    shared_kitti: Path, tmp_path: Path, undisturbed: Path, change: dict[str, object] | None
) -> None:
    out = Path(shutil.copytree(undisturbed, tmp_path / "out"))
    path = out / "shapes" / f"{FRAMES[0]}.npz"
    shapes = read_shapes(path)
    made_of = "{" if change is None else json.dumps({**json.loads(shapes.made_of), **change})
    write_shapes(path, replace(shapes, made_of=made_of))
    if change != {"files": {}}:
        with pytest.raises(DataFormatError, match=path.stem):
            RunFolder(out).read(FRAMES[0])
    assert refine(shared_kitti, out).resumed == FRAMES[1:]
    assert result_files(out) == result_files(undisturbed)


def test_a_run_that_is_asked_to_end_says_so(tmp_path: Path) -> None:
    root, out = tmp_path / "kitti", tmp_path / "out"
    write_data_set(root, tuple(f"{number:06d}" for number in range(16)))
    command = [sys.executable, "-m", "directshape_torch", "refine", *input_options(root), "--out", str(out)]
    command += ["--rig", "none", "--set", "check=off", "--threads", "1"]
    package = str(Path(directshape_torch.__file__).parent.parent)
    run = subprocess.Popen(command, env={**os.environ, "PYTHONPATH": package}, stderr=subprocess.PIPE, text=True)
    try:
        while run.poll() is None and not done_frames(out):
            time.sleep(0.02)
        run.send_signal(signal.SIGTERM)
        _, said = run.communicate(timeout=60)
    finally:
        run.kill()
    # The message stands behind the bar if the signal arrives while the bar is drawn.
    assert run.returncode == 143
    assert said.endswith("directshape: terminated\n")
    assert "Traceback" not in said
    assert read_status(out).num_left > 0
