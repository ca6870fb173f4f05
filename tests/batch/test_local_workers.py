"""Real worker processes: the bytes of one process, whatever happens to them."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from helpers.faulty_refiners import DeadlyRefiner, HungryRefiner, QuickRefiner
from helpers.kitti_folder import write_data_set
from helpers.output_folders import result_files

from directshape_torch.batch.options import RefineOptions, RunObserver, WorkerOptions
from directshape_torch.batch.refine_dataset import refine_dataset
from directshape_torch.batch.run_status import read_status
from directshape_torch.batch.run_summary import RunSummary
from directshape_torch.errors import DirectShapeError
from directshape_torch.io.kitti_dataset import KittiStereoDataset
from directshape_torch.refiner import DirectShapeRefiner

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


def refine(
    root: Path,
    out: Path,
    refiner: DirectShapeRefiner,
    batch_frames: int,
    who: WorkerOptions,
    listener: RunObserver | None = None,
) -> RunSummary:
    dataset = KittiStereoDataset(root, root / "detections", root / "masks")
    return refine_dataset(dataset, refiner, out, RefineOptions("ply", batch_frames=batch_frames), listener, who)


def test_two_workers_of_which_one_is_killed_write_the_bytes_of_one_process(root: Path, tmp_path: Path) -> None:
    refine(root, tmp_path / "one", QuickRefiner(root), 2, WorkerOptions(threads=1))
    listener = Listener()
    deadly = DeadlyRefiner(root, tmp_path, once=[FRAMES[3]])
    summary = refine(root, tmp_path / "two", deadly, 2, WorkerOptions(workers=2), listener)
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
    summary = refine(root, tmp_path / "out", deadly, 1, WorkerOptions(workers=1, retries=0), listener)
    assert summary.exit_code == 1
    assert summary.failed == {FRAMES[1]: "its worker died each of 1 times (killed, out of memory or crashed)"}
    assert sorted(listener.ended) == [(frame_id, frame_id != FRAMES[1]) for frame_id in FRAMES]
    # The next run tries it again, here in this process, and all is as if nothing had happened.
    again = refine(root, tmp_path / "out", QuickRefiner(root), 1, WorkerOptions(threads=1))
    assert (again.exit_code, len(again.resumed)) == (0, 4)
    refine(root, tmp_path / "one", QuickRefiner(root), 1, WorkerOptions(threads=1))
    assert result_files(tmp_path / "out") == result_files(tmp_path / "one")


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="limits of memory are those of Linux")
def test_a_worker_without_the_memory_for_a_call_halves_it(root: Path, tmp_path: Path) -> None:
    summary = refine(root, tmp_path / "hungry", HungryRefiner(root), 4, WorkerOptions(workers=1))
    assert summary.exit_code == 0
    # 4 = 2 + 2 and each 2 = 1 + 1; the fifth frame is alone from the start.
    assert any(warning.startswith("3 calls did not work with all of their frames") for warning in summary.warnings)
    assert sorted(call.frame_ids for call in summary.timings.calls) == [(frame_id,) for frame_id in FRAMES]
    refine(root, tmp_path / "one", QuickRefiner(root), 1, WorkerOptions(threads=1))
    assert result_files(tmp_path / "hungry") == result_files(tmp_path / "one")


def test_what_cannot_be_sent_to_a_worker_says_so(root: Path, tmp_path: Path) -> None:
    class Nameless(QuickRefiner):
        """Of this function: another process cannot import it."""

    with pytest.raises(DirectShapeError, match=r"cannot be sent to other processes.*Nameless"):
        refine(root, tmp_path, Nameless(root), 1, WorkerOptions(workers=1))
