"""`refine --tracks` refines the frames of a track in one call and resumes with the same windows."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers.kitti_folder import FRAMES
from helpers.layouts import write_sequence, write_tracked
from helpers.quick_runs import refiner, result_files

from directshape_torch.batch.frame_groups import track_windows
from directshape_torch.batch.options import RefineOptions
from directshape_torch.batch.refine_dataset import refine_dataset
from directshape_torch.batch.run_summary import RunSummary
from directshape_torch.errors import ResumeError
from directshape_torch.io.result_files import read_shapes
from directshape_torch.io.run_folder import RunFolder
from directshape_torch.io.stereo_dataset import open_dataset
from directshape_torch.tracks import same_car


@pytest.fixture(scope="module")
def sequence(shared_kitti: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The frames of the shared data set as a sequence; the track of every car is its line."""
    root = tmp_path_factory.mktemp("sequence")
    write_sequence(shared_kitti, root, FRAMES, single=True)
    write_tracked(shared_kitti / "detections" / "data", FRAMES, root / "results" / f"{root.name}.txt")
    return root


def refine(kitti: Path, sequence: Path, out: Path, batch_frames: int = 16) -> RunSummary:
    dataset = open_dataset("tracking", sequence, sequence / "results", kitti / "masks", tracks=True)
    return refine_dataset(dataset, refiner(kitti), out, RefineOptions(batch_frames=batch_frames))


@pytest.fixture(scope="module")
def whole(shared_kitti: Path, sequence: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run, which no test changes."""
    out = tmp_path_factory.mktemp("whole")
    assert not refine(shared_kitti, sequence, out).warnings
    return out


def test_views_of_a_track_share_a_shape(whole: Path) -> None:
    # Lines are those of the frame, not of the sequence's file.
    run = RunFolder(whole)
    assert [len(run.read(frame_id).cars) for frame_id in run.frame_ids] == [2] * len(FRAMES)
    frames = [run.read(frame_id).shapes for frame_id in run.frame_ids]
    assert [frame.tracks for frame in frames] == [("000000", "000002")] * len(FRAMES)
    assert [frame.track_parts.tolist() for frame in frames] == [[0, 0]] * len(FRAMES)
    for frame in frames[1:]:
        np.testing.assert_array_equal(frame.codes, frames[0].codes)
        np.testing.assert_array_equal(frame.boxes_hwl, frames[0].boxes_hwl)


def test_split_tracks_are_named(
    shared_kitti: Path, sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Behind the first of three views.
    monkeypatch.setattr(same_car, "_of_one_car", lambda views, *_: [x for x in (views[:-2], views[-2:]) if x])
    (warning,) = refine(shared_kitti, sequence, tmp_path).warnings
    assert warning == "tracks seem to be of two cars, and were split (docs/tracks.md): 000000, 000002"
    frames = [read_shapes(tmp_path / "shapes" / f"{number:06d}.npz") for number in range(len(FRAMES))]
    assert [frame.track_parts[0] for frame in frames] == [-1, 1, 1]


def test_an_interrupted_run_keeps_to_its_windows(
    shared_kitti: Path, sequence: Path, whole: Path, tmp_path: Path
) -> None:
    out = Path(shutil.copytree(whole, tmp_path / "out"))
    (out / "shapes" / "000000.npz").unlink()
    assert refine(shared_kitti, sequence, out).resumed == ("000001", "000002")
    assert result_files(out) == result_files(whole)
    with pytest.raises(ResumeError, match="setting 'track_frames' was 16, now is 1"):
        refine(shared_kitti, sequence, out, batch_frames=1)


def test_windows_cover_every_frame_once() -> None:
    names = [f"{sequence}_{number:03d}" for sequence in "ab" for number in range(37)]
    windows = track_windows(names, lambda name: name[0], 16, finished=())
    assert sorted(name for window in windows for name in window.wanted) == names
    for window in windows:
        assert len(window.frame_ids) == 16
        assert len({name[0] for name in window.frame_ids}) == 1
        for name in window.wanted:
            # In the window's middle half, but at the ends of the sequence.
            place = window.frame_ids.index(name)
            assert 4 <= place <= 11 or "000" in window.frame_ids[0] or "036" in window.frame_ids[-1]
    assert track_windows(names, lambda name: name[0], 16, finished=names) == []
