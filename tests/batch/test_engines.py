"""Frames of workers that die are repeated, and real processes give the same bytes whatever happens to them."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.kitti_folder import write_data_set
from helpers.quick_runs import QuickRefiner, refine, result_files
from numpy.typing import NDArray

from directshape_torch.batch.engines import reports_of
from directshape_torch.batch.frame_groups import FrameGroup, frame_groups
from directshape_torch.batch.group_refinement import GroupReport
from directshape_torch.batch.options import RunObserver
from directshape_torch.errors import DirectShapeError
from directshape_torch.io.run_folder import FrameEntry, read_failure
from directshape_torch.io.run_status import read_status
from directshape_torch.io.stereo_dataset import LoadedFrame

DONE: FrameEntry = {"cars": 1}


class Imagined:
    """An `Imagined` has one worker that dies as it is told."""

    workers = 1

    def __init__(self, dies: Callable[[FrameGroup], bool]) -> None:
        self.dies = dies
        self.calls: list[tuple[str, ...]] = []

    def submit(self, group: FrameGroup) -> Future[GroupReport | None]:
        self.calls.append(group.frame_ids)
        done = {frame_id: DONE for frame_id in group.frame_ids if frame_id in group.wanted}
        future = Future[GroupReport | None]()
        future.set_result(None if self.dies(group) else GroupReport(done))
        return future

    def report(self, future: Future[GroupReport | None]) -> GroupReport | None:
        return future.result()


def ends(workers: Imagined, out: Path, size: int = 1) -> dict[str, FrameEntry]:
    """How all frames ended."""
    reports = reports_of(workers, SimpleNamespace(out_dir=out), frame_groups("abcdefgh", size, ()))
    return {frame_id: entry for report in reports for frame_id, entry in report.ends.items()}


@pytest.mark.parametrize(("killers", "size"), [("c", 4), ("cf", 8)], ids=["one", "one in each half"])
def test_the_frames_that_kill_are_found_among_their_companions(tmp_path: Path, killers: str, size: int) -> None:
    workers = Imagined(lambda group: not set(killers).isdisjoint(group.frame_ids))
    reason = "its worker died each of 2 times (killed, out of memory or crashed)"
    assert ends(workers, tmp_path, size) == {
        **dict.fromkeys("abcdefgh", DONE),
        **{k: {"reason": reason} for k in killers},
    }
    assert read_failure(tmp_path, "c") == reason


@pytest.mark.parametrize("num_good", [0, 3])
def test_many_groups_that_kill_end_the_run_before_all_are_tried(tmp_path: Path, num_good: int) -> None:
    groups = frame_groups([f"{number:06d}" for number in range(4000)], 4, ())
    workers = Imagined(lambda group: group not in groups[:num_good])
    with pytest.raises(DirectShapeError, match=r"workers die again and again \(killed"):
        list(reports_of(workers, SimpleNamespace(out_dir=tmp_path), groups))
    assert not (tmp_path / "failed").exists()
    bad = [group.frame_ids for group in groups[num_good:]]
    assert workers.calls[len(groups) :] == bad[:4]


FRAMES = tuple(f"{number:06d}" for number in range(5))


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("kitti")
    write_data_set(root, FRAMES)
    return root


class Listener(RunObserver):
    def __init__(self) -> None:
        self.ended: list[tuple[str, bool]] = []

    def finished(self, frame_id: str, failure: str | None) -> None:
        self.ended.append((frame_id, failure is None))


def blank(*_: object) -> NDArray[np.uint8]:
    return np.zeros((2, 2), np.uint8)


@dataclass
class DeadlyPicture:
    """A `DeadlyPicture` kills its process at the picture of a frame, the first time."""

    frame_id: str
    note: Path

    def __call__(self, loaded: LoadedFrame, _: object) -> NDArray[np.uint8]:
        if loaded.frame_id == self.frame_id and not self.note.exists():
            self.note.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return blank()


def test_two_workers_of_which_one_is_killed_write_the_bytes_of_one_process(root: Path, tmp_path: Path) -> None:
    """What the dead one had finished stays in the call, and is not written again."""
    refine(root, tmp_path / "one", QuickRefiner(root), draw=blank, batch_frames=2, threads=1)
    listener, deadly = Listener(), DeadlyPicture(FRAMES[3], tmp_path / "note")
    options = {"draw": deadly, "observer": listener, "batch_frames": 2, "workers": 2}
    summary = refine(root, tmp_path / "two", QuickRefiner(root), **options)
    died_at = (tmp_path / "note").stat().st_mtime
    before, after = ((tmp_path / "two" / "shapes" / f"{name}.npz").stat().st_mtime for name in FRAMES[2:4])
    # The clock of files may stand still for some milliseconds.
    assert before <= died_at <= after
    assert summary.exit_code == 0
    assert sorted(listener.ended) == [(frame_id, True) for frame_id in FRAMES]
    expected, found = result_files(tmp_path / "one"), result_files(tmp_path / "two")
    assert {f"shapes/{FRAMES[4]}.npz", "summary.json"} <= set(expected)
    assert found == expected
    assert sorted(call.frame_ids for call in summary.timings.calls) == [FRAMES[:2], FRAMES[2:4], FRAMES[4:]]
    assert (summary.timings.workers, summary.timings.threads) == (2, 1)
    assert read_status(tmp_path / "two").num_done == len(FRAMES)


class OfTwoWordsError(Exception):
    def __init__(self, one: str, other: str) -> None:
        super().__init__(f"{one} {other}")


def draw_nothing(*_: object) -> NDArray[np.uint8]:
    raise OfTwoWordsError("no", "paint")


def test_an_error_of_a_users_code_is_told_and_is_no_death(root: Path, tmp_path: Path) -> None:
    with pytest.raises(DirectShapeError, match="OfTwoWordsError: no paint"):
        refine(root, tmp_path, QuickRefiner(root), draw=draw_nothing, batch_frames=1, workers=1)
    assert multiprocessing.active_children() == []


class Unreadable(QuickRefiner):
    """An `Unreadable` can be sent to another process, which cannot read it."""

    def __setstate__(self, state: object) -> None:
        raise LookupError("it is made of what only the first process has")


def test_what_a_worker_cannot_read_says_so(root: Path, tmp_path: Path) -> None:
    with pytest.raises(DirectShapeError, match=r"a worker cannot read the job: LookupError: it is made of"):
        refine(root, tmp_path, Unreadable(root), batch_frames=1, workers=1)
    assert multiprocessing.active_children() == []


def test_what_cannot_be_sent_to_a_worker_says_so(root: Path, tmp_path: Path) -> None:
    class Nameless(QuickRefiner):
        """A `Nameless` is local to this function, so another process cannot import it."""

    with pytest.raises(DirectShapeError, match=r"cannot be sent to other processes.*Nameless"):
        refine(root, tmp_path, Nameless(root), batch_frames=1, workers=1)
