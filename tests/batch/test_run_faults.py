"""After runs that are killed, cut short or crowded out, the next run ends with the bytes of an undisturbed run."""

from __future__ import annotations

import os
import shutil
import signal
import sys
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from helpers import quick_runs
from helpers.kitti_folder import SIX_FRAMES as FRAMES
from helpers.quick_runs import FEW_STEPS, QuickRefiner, result_files
from helpers.slow_run import PATIENCE_S, slow_run, wait_until

from directshape_torch.batch.options import RefineOptions, RunObserver
from directshape_torch.batch.refine_dataset import refine_dataset
from directshape_torch.errors import ResumeError
from directshape_torch.io.config_files import load_config
from directshape_torch.io.run_folder import done_frames
from directshape_torch.io.run_status import read_status

refine = partial(quick_runs.refine, threads=1)


@pytest.fixture(scope="module")
def root(kitti_of_six: Path) -> Path:
    return kitti_of_six


@pytest.fixture(scope="module")
def undisturbed(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("undisturbed")
    refine(root, out)
    return out


def stopped_in_the_middle(root: Path, out: Path, by: signal.Signals) -> str:
    """What a run with a worker says that is stopped after a frame or two; all of its processes are gone."""
    with slow_run(root, out, 1) as run:
        wait_until(lambda: run.poll() is not None or len(done_frames(out)) > 0)
        assert run.poll() is None, "the run ended before it was stopped"
        status = read_status(out)
        assert status.num_frames == len(FRAMES)
        assert status.num_left == len(FRAMES) - status.num_done > 0
        workers = children(run.pid)
        if by == signal.SIGINT:  # as a terminal does it
            os.killpg(run.pid, by)
        else:
            run.send_signal(by)
        _, said = run.communicate(timeout=PATIENCE_S)
        wait_until(lambda: not any(map(is_running, workers)))
    return said


def children(pid: int) -> list[int]:
    """The child processes, each of which belongs to the thread that started it."""
    lists = Path(f"/proc/{pid}/task").glob("*/children")
    return [int(each) for some in lists for each in some.read_text().split()]


def is_running(pid: int) -> bool:
    """Whether a process exists and is more than an entry that its parent has not removed yet."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks for processes in /proc")
def test_a_run_that_is_killed_and_damaged_goes_on_where_it_was(root: Path, tmp_path: Path, undisturbed: Path) -> None:
    out = tmp_path / "out"
    stopped_in_the_middle(root, out, signal.SIGKILL)
    finished = done_frames(out)
    assert 0 < len(finished) < len(FRAMES)
    assert read_status(out).num_done == len(finished)
    # Everything else that a killed process may leave: a file cut short, a file nobody moved to its name.
    left, at_work = (out / "data" / f".000005.txt.{name}.tmp" for name in ("k3j4", "m5n6"))
    for path in (left, at_work):
        path.write_text("Car 0.00")
    os.utime(left, (0, time.time() - 2 * 3600))
    damaged = out / "shapes" / f"{finished[0]}.npz"
    damaged.write_bytes(damaged.read_bytes()[:1000])
    before = {frame_id: (out / "data" / f"{frame_id}.txt").stat().st_ino for frame_id in finished}

    summary = refine(root, out)
    assert summary.exit_code == 0
    assert sorted(summary.resumed) == sorted(finished[1:])
    assert len(summary.timings.calls) == len(FRAMES) - len(summary.resumed)
    assert any(
        f"files of 1 finished frames were damaged or gone and made again: {finished[0]}" in warning
        for warning in summary.warnings
    )
    for frame_id in finished[1:]:
        assert (out / "data" / f"{frame_id}.txt").stat().st_ino == before[frame_id]
    # The temporary file of this hour may belong to another run.
    at_work.unlink()
    assert not left.exists()
    assert result_files(out) == result_files(undisturbed)
    assert read_status(out).num_left == 0


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks for processes in /proc")
def test_an_interrupted_run_ends_its_frames_and_goes_on(root: Path, tmp_path: Path, undisturbed: Path) -> None:
    out = tmp_path / "out"
    said = stopped_in_the_middle(root, out, signal.SIGINT)
    assert said.count("Traceback") == said.count("KeyboardInterrupt") == 1
    status = read_status(out)
    assert len(list((out / "data").glob("*.txt"))) == status.num_done < len(FRAMES)
    assert len(refine(root, out).resumed) == status.num_done
    assert result_files(out) == result_files(undisturbed)


@pytest.mark.long
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks for processes in /proc")
def test_workers_that_still_start_say_nothing_of_an_interrupt(root: Path, tmp_path: Path) -> None:
    with slow_run(root, tmp_path / "out") as run:
        wait_until(lambda: len(children(run.pid)) == 3)  # two workers, one that looks after what processes share
        os.killpg(run.pid, signal.SIGINT)
        _, said = run.communicate(timeout=PATIENCE_S)
    assert said.count("Traceback") == said.count("KeyboardInterrupt") == 1


@pytest.mark.long
def test_two_runs_at_once(root: Path, tmp_path: Path, undisturbed: Path) -> None:
    with slow_run(root, tmp_path / "out") as one, slow_run(root, tmp_path / "out") as other:
        for run in (one, other):
            _, said = run.communicate(timeout=PATIENCE_S)
            assert run.returncode == 0, said
    assert result_files(tmp_path / "out") == result_files(undisturbed)


class Partner(RunObserver):
    """A `Partner` refines frames into the same folder after the first frame has ended."""

    def __init__(self, root: Path, out: Path, frames: Sequence[str]) -> None:
        self.root, self.out, self.frames = root, out, frames

    def finished(self, frame_id: str, failure: str | None) -> None:
        if frame_id == FRAMES[0]:
            rest = quick_runs.dataset(self.root, frames=self.frames)
            refine_dataset(rest, QuickRefiner(self.root), self.out, RefineOptions(threads=1))


@pytest.mark.parametrize(("own", "others"), [(FRAMES[:2], FRAMES[2:]), (FRAMES, FRAMES)], ids=["pieces", "the same"])
def test_two_runs_share_a_folder(
    root: Path, tmp_path: Path, undisturbed: Path, own: tuple[str, ...], others: tuple[str, ...]
) -> None:
    piece, partner = quick_runs.dataset(root, frames=own), Partner(root, tmp_path, others)
    summary = refine_dataset(piece, QuickRefiner(root), tmp_path, RefineOptions(threads=1), partner)
    assert list(summary.frames) == list(own)
    assert result_files(tmp_path) == result_files(undisturbed)


class Rival(RunObserver):
    """A `Rival` starts a run with other settings into the folder after the first frame has ended."""

    def __init__(self, root: Path, out: Path) -> None:
        self.root, self.out = root, out

    def finished(self, frame_id: str, failure: str | None) -> None:
        if frame_id == FRAMES[0]:
            rival = quick_runs.refiner(self.root, load_config(None, [*FEW_STEPS, "silhouette.weight=6"]))
            refine(self.root, self.out, rival, fresh=True)


def test_a_run_whose_folder_another_one_has_taken_says_so(root: Path, tmp_path: Path) -> None:
    with pytest.raises(ResumeError, match=r"refiner\.silhouette\.weight' was 6\.0, now is 12\.0"):
        refine(root, tmp_path, observer=Rival(root, tmp_path))


@pytest.mark.parametrize("name", ["data/000002.txt", "shapes/000002.npz"])
def test_a_file_whose_bytes_have_changed_is_made_again(
    root: Path, tmp_path: Path, undisturbed: Path, name: str
) -> None:
    out = Path(shutil.copytree(undisturbed, tmp_path / "out"))
    if name.endswith("npz"):
        shapes = dict(np.load(out / name))
        np.savez(out / name, **{**shapes, "codes": shapes["codes"] + 1})
    else:
        (out / name).write_text((out / name).read_text().replace("Car", "Van"))
    summary = refine(root, out)
    assert summary.resumed == tuple(frame for frame in FRAMES if frame != "000002")
    assert result_files(out) == result_files(undisturbed)


def test_frames_of_a_group_that_was_cut_get_the_bytes_of_the_whole_group(root: Path, tmp_path: Path) -> None:
    refine(root, tmp_path / "whole", batch_frames=3)
    shutil.copytree(tmp_path / "whole", tmp_path / "cut")
    for path in (tmp_path / "cut").glob(f"*/{FRAMES[1]}.*"):
        path.unlink()
    kept = (tmp_path / "cut" / "data" / f"{FRAMES[0]}.txt").stat().st_ino
    summary = refine(root, tmp_path / "cut", batch_frames=3)
    assert summary.resumed == (FRAMES[0], *FRAMES[2:])
    assert [call.frame_ids for call in summary.timings.calls] == [FRAMES[:3]]
    assert (tmp_path / "cut" / "data" / f"{FRAMES[0]}.txt").stat().st_ino == kept
    assert result_files(tmp_path / "cut") == result_files(tmp_path / "whole")


def test_a_fresh_start_removes_results_and_nothing_else(root: Path, tmp_path: Path, undisturbed: Path) -> None:
    out = Path(shutil.copytree(undisturbed, tmp_path / "out"))
    (out / "data" / "notes.txt").write_text("mine")
    (out / "shapes" / "000003.npz").write_bytes(b"damaged")
    summary = refine(root, out, fresh=True)
    assert summary.resumed == ()
    assert len(summary.timings.calls) == len(FRAMES)
    assert (out / "data" / "notes.txt").read_text() == "mine"
    (out / "data" / "notes.txt").unlink()
    assert result_files(out) == result_files(undisturbed)


def test_other_threads_than_before_are_a_warning(root: Path, tmp_path: Path, undisturbed: Path) -> None:
    out = Path(shutil.copytree(undisturbed, tmp_path / "out"))
    (out / "data" / "000002.txt").unlink()
    assert any(
        "batch_frames: 1 in the previous run, 2 now; the last digits" in warning
        for warning in refine(root, out, batch_frames=2).warnings
    )
