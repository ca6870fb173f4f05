"""Times of frames and poses of the camera get from the files of a sequence into the tensors of a call."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.layouts import DRIVE, SEQUENCE, put, write, write_folder, write_raw, write_sequence

from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.io.frame_collation import collate
from directshape_torch.io.motion_files import of_line, read_poses, read_times
from directshape_torch.io.stereo_dataset import open_dataset

FRAMES = ("000000", "000001")
TURNED = "0.8 0 0.6 1 0 1 0 2 -0.6 0 0.8 3"
POSES = "1 0 0 0 0 1 0 0 0 0 1 0\n" + TURNED + "\n"


@pytest.mark.parametrize("single", [True, False])
def test_times_and_poses_of_tracking_sequences(kitti: Path, tmp_path: Path, single: bool) -> None:
    root = tmp_path / SEQUENCE
    write_sequence(kitti, root, FRAMES, single)
    base = root if single else root / "training"
    write(base / ("times.txt" if single else f"times/{SEQUENCE}.txt"), "100.5\n100.625\n")
    write(base / ("poses.txt" if single else f"poses/{SEQUENCE}.txt"), POSES)
    for frame_id in FRAMES:
        put(kitti / "detections" / "data" / f"{frame_id}.txt", tmp_path / "found" / SEQUENCE / f"{frame_id}.txt")
    dataset = open_dataset("tracking", root, tmp_path / "found" / (SEQUENCE if single else ""), tracks=True)
    frames, _ = collate([dataset.load(frame_id) for frame_id in dataset.frame_ids])
    assert frames.time_s.tolist() == [0.0, 0.125]
    # A point of the left camera, by way of the frame that the poses are of.
    x_cam = torch.tensor([1.0, 2.0, 10.0, 1.0])
    x_ref = x_cam[:3] - frames.camera.t_cam_ref[1]
    R, t = torch.tensor([[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]]), torch.tensor([1.0, 2.0, 3.0])
    torch.testing.assert_close((frames.T_world_cam[1] @ x_cam)[:3], R @ x_ref + t)


def test_a_raw_drive_brings_its_times(kitti: Path, tmp_path: Path) -> None:
    drive = write_raw(kitti, tmp_path / "raw", FRAMES)
    stamps = "2011-09-26 13:02:44.944915456\n2011-09-26 13:02:45.048214528\n"
    write(drive / "image_02" / "timestamps.txt", stamps)
    for number, frame_id in enumerate(FRAMES):
        put(kitti / "detections" / "data" / f"{frame_id}.txt", tmp_path / "found" / DRIVE / f"{number:010d}.txt")
    dataset = open_dataset("raw", tmp_path / "raw", tmp_path / "found", tracks=True)
    frames, _ = collate([dataset.load(frame_id) for frame_id in dataset.frame_ids])
    assert frames.time_s.tolist() == pytest.approx([0.0, 0.103299], abs=2e-6)
    assert frames.T_world_cam is None
    assert "times" in dataset.input_files(dataset.frame_ids[0])
    alone = open_dataset("raw", tmp_path / "raw", tmp_path / "found")
    assert alone.load(dataset.frame_ids[0]).frame.time_s is None
    assert "times" not in alone.input_files(dataset.frame_ids[0])


def test_a_folder_says_it_in_its_frames(kitti: Path, tmp_path: Path) -> None:
    write_folder(kitti, tmp_path, FRAMES)
    pose = np.eye(4)
    for number, path in enumerate(sorted((tmp_path / "frames").glob("*.json"))):
        pose[2, 3] = 1.5 * number
        content = {**json.loads(path.read_text()), "time_s": 0.25 * number, "T_world_cam": pose.tolist()}
        path.write_text(json.dumps(content))
    dataset = open_dataset("folder", tmp_path, tracks=True)
    frames, _ = collate([dataset.load(frame_id) for frame_id in dataset.frame_ids])
    assert frames.time_s.tolist() == [0.0, 0.25]
    assert frames.T_world_cam[:, 2, 3].tolist() == [0.0, 1.5]
    path.write_text(json.dumps({**content, "T_world_cam": (2 * pose).tolist()}))
    with pytest.raises(DataFormatError, match="T_world_cam' is no rigid motion"):
        dataset.load(dataset.frame_ids[1])


def test_poses_count_from_the_first(tmp_path: Path) -> None:
    """However far away their world begins: float32 knows seven digits."""
    far = "1 0 0 5400000.0 0 1 0 0 0 0 1 0\n1 0 0 5400000.1 0 1 0 0 0 0 1 0\n"
    write(tmp_path / "poses.txt", far)
    assert read_poses(tmp_path / "poses.txt")[:, 0, 3].tolist() == pytest.approx([0, 0.1], abs=1e-6)


@pytest.mark.parametrize(
    ("read", "text", "said"),
    [
        (read_times, "0.0\nsoon\n", "line 2.*seconds or a date"),
        (read_times, "0.0\nnan\n", "line 2.*finite"),
        (read_times, "0.0\n0.1\n\n0.1\n", "line 4.*time does not go on"),
        (read_poses, "1 2 3\n", "line 1.*12 finite numbers, got 3"),
        (read_poses, POSES.replace("0.6", "0.5"), "line 2.*no rotation"),
        (read_poses, POSES.replace("1 0 0 0", "1 0 0 inf"), "line 1: column 4 is 'inf', not a finite number"),
        (read_poses, POSES.replace("0.8", "O.8"), "line 2: column 1 is 'O.8', not a finite"),
    ],
)
def test_damaged_files_are_named_with_the_line(read: object, text: str, said: str, tmp_path: Path) -> None:
    assert callable(read)
    write(tmp_path / "file.txt", text)
    with pytest.raises(DataFormatError, match=said):
        read(tmp_path / "file.txt")


def test_a_frame_without_a_line_is_named(tmp_path: Path) -> None:
    write(tmp_path / "times.txt", "0\n1\n")
    with pytest.raises(DataFormatError, match="has 2 lines and none for frame 2"):
        of_line(tmp_path / "times.txt", read_times(tmp_path / "times.txt"), 2)


def test_a_frame_without_a_number_is_named(kitti: Path, tmp_path: Path) -> None:
    write_sequence(kitti, tmp_path, FRAMES, single=True)
    write(tmp_path / "times.txt", "0\n1\n")
    for folder in ("image_02", "image_03"):
        put(tmp_path / folder / "000000.png", tmp_path / folder / "first.png")
    write(tmp_path / "found" / "first.txt", "")
    dataset = open_dataset("tracking", tmp_path, tmp_path / "found", tracks=True)
    with pytest.raises(InputError, match="names that end with numbers, for a file of their sequence, got 'first'"):
        dataset.load("first")
