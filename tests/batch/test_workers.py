"""Frames of workers that die are repeated, and real processes give the same bytes whatever happens to them."""

from __future__ import annotations

import multiprocessing
import sys
from collections.abc import Callable, Collection
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path

import pytest
from helpers import quick_runs
from helpers.faulty_refiners import DeadlyRefiner, HungryRefiner, QuickRefiner
from helpers.kitti_folder import write_data_set
from helpers.output_folders import result_files

from directshape_torch.batch.frame_groups import FrameGroup, frame_groups
from directshape_torch.batch.group_refinement import GroupReport
from directshape_torch.batch.options import RunObserver
from directshape_torch.batch.workers import reports_of
from directshape_torch.errors import DirectShapeError
from directshape_torch.io.run_manifest import FrameEntry
from directshape_torch.io.run_status import read_status

DONE: FrameEntry = {"state": "done"}


class Imagined:
    """An `Imagined` has workers that die as they are told; the latest group returns first."""

    def __init__(self, capacity: int, dies: Callable[[FrameGroup, int], bool]) -> None:
        self.capacity, self.dies = capacity, dies
        self.at_work: list[FrameGroup] = []
        self.calls: list[tuple[str, ...]] = []
        self.written: list[str] = []

    def hand_out(self, group: FrameGroup) -> None:
        self.at_work.append(group)
        assert len(self.at_work) <= self.capacity

    def next_reports(self) -> list[tuple[FrameGroup, GroupReport | None]]:
        group = self.at_work.pop()
        times_before = self.calls.count(group.frame_ids)
        self.calls.append(group.frame_ids)
        if self.dies(group, times_before):
            return [(group, None)]
        done = [frame_id for frame_id in group.frame_ids if frame_id in group.wanted]
        self.written += done
        return [(group, GroupReport(dict.fromkeys(done, DONE)))]


def ends(
    workers: Imagined, size: int = 1, retries: int = 1, frames: str = "abcdefgh", finished: Collection[str] = ()
) -> dict[str, FrameEntry]:
    """How all frames ended."""
    reports = reports_of(
        workers, frame_groups(frames, size, ()), retries, lambda frame_id: DONE if frame_id in finished else None
    )
    return {frame_id: entry for report in reports for frame_id, entry in report.ends.items()}


@pytest.mark.parametrize("retries", [0, 1, 2])
def test_the_frame_that_kills_is_found_among_its_companions(retries: int) -> None:
    workers = Imagined(2, lambda group, _: "c" in group.frame_ids)
    found = ends(workers, size=4, retries=retries)
    assert sorted(workers.written) == list("abdefgh")
    reason = f"its worker died each of {retries + 1} times (killed, out of memory or crashed)"
    assert found == {**dict.fromkeys("abdefgh", DONE), "c": {"state": "failed", "reason": reason}}
    for group in (("a", "b", "c", "d"), ("c", "d"), ("c",)):
        assert workers.calls.count(group) == retries + 1


def test_what_was_finished_before_the_death_is_not_written_again() -> None:
    workers = Imagined(1, lambda group, before: "a" in group.frame_ids and before == 0)
    assert ends(workers, 3, frames="abc", finished="ab") == dict.fromkeys("abc", DONE)
    # All three are in the call again, for the sake of the bytes of the third.
    assert workers.calls == [("a", "b", "c")] * 2
    assert workers.written == ["c"]
    assert ends(Imagined(1, lambda *_: True), 3, frames="abc", finished="abc") == dict.fromkeys("abc", DONE)


def test_workers_that_never_finish_anything_end_the_run() -> None:
    workers = Imagined(1, lambda *_: True)
    with pytest.raises(DirectShapeError, match=r"workers die before they finish any frame \(killed"):
        ends(workers)
    assert len(workers.calls) == 6


refine = partial(quick_runs.refine, meshes="ply")
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


def test_two_workers_of_which_one_is_killed_write_the_bytes_of_one_process(root: Path, tmp_path: Path) -> None:
    refine(root, tmp_path / "one", QuickRefiner(root), batch_frames=2, threads=1)
    listener = Listener()
    deadly = DeadlyRefiner(root, tmp_path, once=[FRAMES[3]])
    summary = refine(root, tmp_path / "two", deadly, observer=listener, batch_frames=2, workers=2)
    assert (tmp_path / FRAMES[3]).exists(), "nobody was killed"
    assert summary.exit_code == 0
    assert sorted(listener.ended) == [(frame_id, True) for frame_id in FRAMES]
    expected, found = result_files(tmp_path / "one"), result_files(tmp_path / "two")
    assert {f"meshes/{FRAMES[4]}_1.ply", f"shapes/{FRAMES[4]}.npz", "summary.json"} <= set(expected)
    assert found == expected
    assert sorted(call.frame_ids for call in summary.timings.calls) == [FRAMES[:2], FRAMES[2:4], FRAMES[4:]]
    assert (summary.timings.workers, summary.timings.threads) == (2, 1)
    run = read_status(tmp_path / "two")
    assert (run.state, run.num_done) == ("finished", len(FRAMES))


def test_a_frame_that_kills_its_worker_fails_and_the_others_go_on(root: Path, tmp_path: Path) -> None:
    deadly = DeadlyRefiner(root, tmp_path, always=[FRAMES[1]])
    listener = Listener()
    summary = refine(root, tmp_path / "out", deadly, observer=listener, batch_frames=1, workers=1, retries=0)
    assert summary.exit_code == 1
    assert summary.failed == {FRAMES[1]: "its worker died each of 1 times (killed, out of memory or crashed)"}
    assert sorted(listener.ended) == [(frame_id, frame_id != FRAMES[1]) for frame_id in FRAMES]
    # The next run tries it again, here in this process, and all is as if nothing had happened.
    again = refine(root, tmp_path / "out", QuickRefiner(root), batch_frames=1, threads=1)
    assert (again.exit_code, len(again.resumed)) == (0, 4)
    refine(root, tmp_path / "one", QuickRefiner(root), batch_frames=1, threads=1)
    assert result_files(tmp_path / "out") == result_files(tmp_path / "one")


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="limits of memory are those of Linux")
def test_a_worker_without_the_memory_for_a_call_halves_it(root: Path, tmp_path: Path) -> None:
    summary = refine(root, tmp_path / "hungry", HungryRefiner(root), batch_frames=4, workers=1)
    assert summary.exit_code == 0
    # 4 = 2 + 2 and each 2 = 1 + 1; the fifth frame is alone from the start.
    assert any(warning.startswith("3 calls did not work with all of their frames") for warning in summary.warnings)
    assert sorted(call.frame_ids for call in summary.timings.calls) == [(frame_id,) for frame_id in FRAMES]
    refine(root, tmp_path / "one", QuickRefiner(root), batch_frames=1, threads=1)
    assert result_files(tmp_path / "hungry") == result_files(tmp_path / "one")


def fails_once(monkeypatch: pytest.MonkeyPatch, error: BaseException) -> None:
    """A wrapper that makes the first received report end in an error."""
    receive, errors = Connection.recv, [error]

    def recv(pipe: Connection) -> object:
        report = receive(pipe)
        if errors:
            raise errors.pop()
        return report

    monkeypatch.setattr(Connection, "recv", recv)


def test_no_worker_is_left_by_an_interrupt_at_a_report(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fails_once(monkeypatch, KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        refine(root, tmp_path, QuickRefiner(root), batch_frames=1, workers=2)
    assert multiprocessing.active_children() == []


def test_a_worker_that_dies_within_its_report_is_replaced(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fails_once(monkeypatch, OSError("got end of file during message"))
    summary = refine(root, tmp_path / "out", QuickRefiner(root), batch_frames=1, workers=1)
    assert summary.exit_code == 0
    assert multiprocessing.active_children() == []
    refine(root, tmp_path / "one", QuickRefiner(root), batch_frames=1, threads=1)
    assert result_files(tmp_path / "out") == result_files(tmp_path / "one")


def test_what_cannot_be_sent_to_a_worker_says_so(root: Path, tmp_path: Path) -> None:
    class Nameless(QuickRefiner):
        """A `Nameless` is local to this function, so another process cannot import it."""

    with pytest.raises(DirectShapeError, match=r"cannot be sent to other processes.*Nameless"):
        refine(root, tmp_path, Nameless(root), batch_frames=1, workers=1)
