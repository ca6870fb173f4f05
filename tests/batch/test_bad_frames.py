"""Frames that cannot be read, refined or written are reported and touch no others."""

from __future__ import annotations

import errno
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.kitti_folder import FRAMES
from helpers.quick_runs import QuickRefiner, dataset, refine, refiner, result_files

from directshape_torch.batch.options import RunObserver
from directshape_torch.batch.refine_dataset import refine_dataset
from directshape_torch.errors import DirectShapeError
from directshape_torch.io.run_status import read_status
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.scene.frames import FrameBatch


def test_a_truncated_image_is_reported_and_the_others_go_on(kitti_copy: Path, tmp_path: Path) -> None:
    refine(kitti_copy, tmp_path / "whole")
    image = kitti_copy / "training" / "image_3" / "000001.png"
    content = image.read_bytes()
    image.write_bytes(content[: len(content) // 2])
    summary = refine(kitti_copy, tmp_path / "out")
    assert summary.exit_code == 1
    assert list(summary.failed) == ["000001"]
    assert "image_3/000001.png" in summary.failed["000001"]
    assert (tmp_path / "out" / "failed" / "000001.txt").read_text() == summary.failed["000001"] + "\n"
    status = read_status(tmp_path / "out")
    assert (status.failed, status.num_done, status.num_left) == (summary.failed, 2, 0)
    assert not (tmp_path / "out" / "data" / "000001.txt").exists()
    for name in ("data/000000.txt", "data/000002.txt", "shapes/000002.npz"):
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    # Mended, the frame is tried again, and all is as if nothing had happened.
    image.write_bytes(content)
    again = refine(kitti_copy, tmp_path / "out")
    assert (again.resumed, again.failed) == (("000000", "000002"), {})
    assert result_files(tmp_path / "out") == result_files(tmp_path / "whole")


def test_an_unforeseen_error_fails_its_frame_alone(shared_kitti: Path, tmp_path: Path) -> None:
    class Sensitive(QuickRefiner):
        def forward(self, frames: FrameBatch, *args: Any) -> RefinementResult:
            if FRAMES[1] in frames.frame_ids:
                raise ZeroDivisionError("of this frame alone")
            return super().forward(frames, *args)

    summary = refine(shared_kitti, tmp_path, Sensitive(shared_kitti), batch_frames=3)
    assert summary.failed == {FRAMES[1]: "ZeroDivisionError: of this frame alone"}


def test_too_little_memory_says_what_to_do(shared_kitti: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_memory(*_: object) -> None:
        raise torch.OutOfMemoryError("CUDA is full")

    too_big = refiner(shared_kitti)
    monkeypatch.setattr(too_big, "forward", no_memory)
    summary = refine(shared_kitti, tmp_path, too_big, batch_frames=3)
    assert summary.exit_code == 1
    assert list(summary.failed) == list(FRAMES)
    assert "too little memory for 1 frame in a call (OutOfMemoryError: " in summary.failed["000002"]
    # 3 = 2 + 1, and 2 = 1 + 1.
    assert any(warning.startswith("2 calls did not work with all of their frames") for warning in summary.warnings)


class Narrow(QuickRefiner):
    """A `Narrow` asks for more memory than there is where it gets several frames."""

    def forward(self, frames: FrameBatch, *args: Any) -> RefinementResult:
        if len(frames) > 1:
            torch.empty(2**50)
        return super().forward(frames, *args)


def test_a_call_without_the_memory_for_its_frames_is_halved(shared_kitti: Path, tmp_path: Path) -> None:
    summary = refine(shared_kitti, tmp_path / "narrow", Narrow(shared_kitti), batch_frames=3)
    assert summary.exit_code == 0
    assert sorted(call.frame_ids for call in summary.timings.calls) == [(frame_id,) for frame_id in FRAMES]
    refine(shared_kitti, tmp_path / "one", batch_frames=1)
    assert result_files(tmp_path / "narrow") == result_files(tmp_path / "one")


def test_a_file_that_cannot_be_written_is_reported_and_the_others_go_on(shared_kitti: Path, tmp_path: Path) -> None:
    refine_dataset(dataset(shared_kitti, frames=["000000"]), refiner(shared_kitti), tmp_path)
    (tmp_path / "data" / "000001.txt").mkdir()
    summary = refine(shared_kitti, tmp_path)
    assert summary.exit_code == 1
    assert list(summary.failed) == ["000001"]
    assert "data/000001.txt" in summary.failed["000001"]
    assert (tmp_path / "data" / "000002.txt").is_file()


def test_a_full_disk_stops_the_run_and_the_next_goes_on(
    shared_kitti: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    class Filler(RunObserver):
        def finished(self, frame_id: str, failure: str | None) -> None:
            monkeypatch.setattr("directshape_torch.batch.group_refinement.write_frame_outputs", full)

    out = tmp_path / "out"
    with pytest.raises(DirectShapeError, match=r"cannot write to .*No space left.*run the same command again"):
        refine(shared_kitti, out, observer=Filler())
    monkeypatch.undo()
    assert not list(out.rglob("*.tmp"))
    summary = refine(shared_kitti, out)
    assert (summary.resumed, summary.exit_code) == (FRAMES[:1], 0)
    refine(shared_kitti, tmp_path / "whole")
    assert result_files(out) == result_files(tmp_path / "whole")
