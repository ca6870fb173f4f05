"""The same frames in every layout give the same tensors."""

from __future__ import annotations

import json
import pickle
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from helpers.layouts import (
    DAY,
    DRIVE,
    SEQUENCE,
    put,
    write,
    write_folder,
    write_odometry,
    write_raw,
    write_sequence,
    write_stereo2015,
    write_tracked,
)
from helpers.matched_masks import instances

from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.io.stereo_dataset import LayoutName, LoadedFrame, StereoDataset, open_dataset

FRAMES = ("000000", "000001")


@pytest.fixture(scope="module")
def expected(kitti: Path) -> LoadedFrame:
    return open_dataset("kitti", kitti, kitti / "detections", kitti / "masks", dtype=torch.float64).load("000001")


def renamed(kitti: Path, to: Path, names: tuple[str, ...]) -> tuple[Path, Path]:
    """Detections and masks of the frames under other names."""
    for frame_id, name in zip(FRAMES, names, strict=True):
        put(kitti / "detections" / "data" / f"{frame_id}.txt", to / "detections" / f"{name}.txt")
        put(kitti / "masks" / f"{frame_id}.json", to / "masks" / f"{name}.json")
    return to / "detections", to / "masks"


def assert_same(dataset: StereoDataset, frame_id: str, expected: LoadedFrame) -> None:
    """Assert equal tensors, also for a copy as other processes get it."""
    dataset = pickle.loads(pickle.dumps(dataset))
    loaded = dataset.load(frame_id)
    assert loaded.frame_id == frame_id
    assert loaded.refined_rows == expected.refined_rows == (0, -1, 1)
    assert dataset.objects(frame_id) == loaded.input_objects
    for name in ("images_left", "images_right", "sizes"):
        torch.testing.assert_close(getattr(loaded.frame, name), getattr(expected.frame, name), atol=0, rtol=0)
    for name in ("K_left", "K_right", "T_right_cam"):
        torch.testing.assert_close(getattr(loaded.frame.camera, name), getattr(expected.frame.camera, name))
    for name in ("T_cam_obj", "dimensions_hwl", "box_2d", "score"):
        torch.testing.assert_close(getattr(loaded.detections, name), getattr(expected.detections, name))
    for name in ("mask_left", "mask_right"):
        assert getattr(loaded.detections, name).dense().equal(getattr(expected.detections, name).dense())
    for role, path in dataset.input_files(frame_id).items():
        assert path.is_file(), role


def test_one_raw_drive(kitti: Path, tmp_path: Path, expected: LoadedFrame) -> None:
    drive = write_raw(kitti, tmp_path, FRAMES)
    detections, masks = renamed(kitti, tmp_path, ("0000000000", "0000000001"))
    dataset = open_dataset("raw", drive, detections, masks, dtype=torch.float64)
    assert dataset.frame_ids == ("0000000000", "0000000001")
    assert_same(dataset, "0000000001", expected)
    assert dataset.load("0000000001").labels is None
    assert dataset.load("0000000001").frame.ground.source == ("file",)
    assert open_dataset("raw", drive, detections, masks, frames=[1]).frame_ids == ("0000000001",)


def test_raw_drives_of_a_day(kitti: Path, tmp_path: Path, expected: LoadedFrame) -> None:
    drive = write_raw(kitti, tmp_path, FRAMES)
    shutil.copytree(drive, drive.parent / "2011_09_26_drive_0009_sync")
    detections, masks = renamed(kitti, tmp_path, (f"{DRIVE}/data/0000000000", f"{DRIVE}/data/0000000001"))
    for root in (tmp_path / DAY, tmp_path):
        dataset = open_dataset("raw", root, detections, masks, dtype=torch.float64)
        # The other drive has no detections.
        assert dataset.frame_ids == (f"{DRIVE}_0000000000", f"{DRIVE}_0000000001")
        assert_same(dataset, f"{DRIVE}_0000000001", expected)
    with pytest.raises(InputError, match=rf"such as {DRIVE}_0000000000, got 1"):
        open_dataset("raw", tmp_path, detections, masks, frames=[1])


def test_one_tracking_sequence(kitti: Path, tmp_path: Path, expected: LoadedFrame) -> None:
    write_sequence(kitti, tmp_path, FRAMES, single=True)
    dataset = open_dataset("tracking", tmp_path, kitti / "detections", kitti / "masks", dtype=torch.float64)
    assert_same(dataset, "000001", expected)
    labels = dataset.load("000001").labels
    assert [label.location_ref for label in labels] == [label.location_ref for label in expected.labels]


@pytest.mark.parametrize("split", ["training", "testing"])
def test_tracking_benchmark_with_one_result_file_a_sequence(
    kitti: Path, tmp_path: Path, expected: LoadedFrame, split: str
) -> None:
    write_sequence(kitti, tmp_path, FRAMES, single=False)
    (tmp_path / "training").rename(tmp_path / split)
    _, masks = renamed(kitti, tmp_path, (f"{SEQUENCE}/000000", f"{SEQUENCE}/000001"))
    write_tracked(kitti / "detections" / "data", FRAMES, tmp_path / "results" / f"{SEQUENCE}.txt")
    for root in (tmp_path, tmp_path / split):
        dataset = open_dataset("tracking", root, tmp_path / "results", masks, dtype=torch.float64)
        assert dataset.frame_ids == (f"{SEQUENCE}_000000", f"{SEQUENCE}_000001")
        assert_same(dataset, f"{SEQUENCE}_000001", expected)
    dataset.objects(f"{SEQUENCE}_000001").clear()  # a list of the caller's own
    # Results name what they came from, without the frame and the track.
    assert dataset.objects(f"{SEQUENCE}_000001")[0].raw_line == expected.input_objects[0].raw_line
    write(tmp_path / "results" / f"{SEQUENCE}.txt", "0 7 Car 1 2")
    with pytest.raises(DataFormatError, match=r"0005\.txt, line 1: expected 17 or 18 columns"):
        open_dataset("tracking", tmp_path, tmp_path / "results", masks).objects(f"{SEQUENCE}_000000")


def test_tracking_frames_called_by_sequence_in_one_folder(kitti: Path, tmp_path: Path, expected: LoadedFrame) -> None:
    write_sequence(kitti, tmp_path, FRAMES, single=False)
    detections, masks = renamed(kitti, tmp_path, (f"{SEQUENCE}_000000", f"{SEQUENCE}_000001"))
    dataset = open_dataset("tracking", tmp_path, detections, masks, dtype=torch.float64)
    assert_same(dataset, f"{SEQUENCE}_000001", expected)
    # Which frames belong together is asked of every frame of a data set, by every process of a run.
    shutil.rmtree(tmp_path / "training")
    assert replace(dataset, tracks=True).sequence_of(f"{SEQUENCE}_000001") == SEQUENCE


@pytest.mark.parametrize("where", ["testing", "training/../testing", "."])
def test_the_object_benchmark_without_a_training_folder(kitti_copy: Path, expected: LoadedFrame, where: str) -> None:
    (kitti_copy / "training").rename(kitti_copy / "testing")
    (kitti_copy / "training").mkdir()
    root = kitti_copy / where
    dataset = open_dataset("kitti", root, kitti_copy / "detections", kitti_copy / "masks", dtype=torch.float64)
    assert_same(dataset, "000001", expected)


@pytest.mark.parametrize("root", ["", "dataset"])
def test_odometry(kitti: Path, tmp_path: Path, expected: LoadedFrame, root: str) -> None:
    write_odometry(kitti, tmp_path / root, FRAMES)
    detections, masks = renamed(kitti, tmp_path, ("04/000000", "04/000001"))
    dataset = open_dataset("odometry", tmp_path, detections, masks, tracks=True, dtype=torch.float64)
    assert dataset.frame_ids == ("04_000000", "04_000001")
    assert_same(dataset, "04_000001", expected)
    frame = dataset.load("04_000001").frame
    assert frame.time_s is not None
    assert frame.time_s.tolist() == pytest.approx([0.1])
    assert frame.T_world_cam is not None
    assert float(frame.T_world_cam[0, 2, 3]) == pytest.approx(1, abs=0.01)
    one = open_dataset(
        "odometry", tmp_path / root / "sequences" / "04", detections / "04", masks / "04", dtype=torch.float64
    )
    assert_same(one, "000001", expected)


@pytest.mark.parametrize(
    "text", ["1", "000001", "000001.png", "image_2/000001.PNG\r", "  1  ", "\ufeff000001.txt", "training/000001"]
)
def test_a_line_of_a_split_names_a_frame_in_many_ways(kitti: Path, tmp_path: Path, text: str) -> None:
    write(tmp_path / "split.txt", f"{text}\n\n1\n")
    dataset = open_dataset("kitti", kitti, kitti / "detections", kitti / "masks", split=tmp_path / "split.txt")
    assert dataset.frame_ids == ("000001",)


def test_a_split_of_raw_drives_and_lines_that_name_nothing(kitti: Path, tmp_path: Path) -> None:
    drive = write_raw(kitti, tmp_path, FRAMES)
    shutil.copytree(drive, drive.parent / "2011_09_26_drive_0009_sync")
    detections, masks = renamed(kitti, tmp_path, (f"{DRIVE}/data/0000000000", f"{DRIVE}/data/0000000001"))
    split = tmp_path / "split.txt"
    write(split, f"{DAY}/{DRIVE} 0000000001 l\n{DAY}/2011_09_26_drive_0009_sync 0000000000 r\n")
    dataset = open_dataset("raw", tmp_path / DAY, detections, masks, split=split)
    # The second has no detections, which is said when its turn comes.
    assert dataset.frame_ids == (f"{DRIVE}_0000000001", "2011_09_26_drive_0009_sync_0000000000")
    write(split, f"{DAY}/{DRIVE} 0000000001 l\n{DAY}/{DRIVE} 0000000777 l\n")
    with pytest.raises(DataFormatError, match=rf"split.txt, line 2: names no frame of the data: .* such as {DRIVE}"):
        open_dataset("raw", tmp_path / DAY, detections, masks, split=split)


def test_a_split_of_drives_where_one_is_open(kitti: Path, tmp_path: Path) -> None:
    """Frames of other drives have the same numbers, and words are no drive."""
    drive = write_raw(kitti, tmp_path, FRAMES)
    detections, masks = renamed(kitti, tmp_path, ("data/0000000000", "data/0000000001"))
    split = tmp_path / "split.txt"
    write(split, f"{DAY}/{DRIVE} 0000000001 l\n")
    assert open_dataset("raw", drive, detections, masks, split=split).frame_ids == ("0000000001",)
    for line in (f"{DAY}/2011_09_26_drive_0009_sync 0000000001 l", "frame 1 was bad", "0001 000000", "1 0"):
        write(split, f"0000000000\n{line}\n")
        with pytest.raises(DataFormatError, match=r"split.txt, line 2: names no frame of the data"):
            open_dataset("raw", drive, detections, masks, split=split)


@pytest.mark.parametrize("name", ["0005.txt", "instances.txt"])
def test_text_masks_of_kitti_mots(kitti: Path, tmp_path: Path, name: str) -> None:
    """The left masks of every form are the same, and their numbers are tracks."""
    write_sequence(kitti, tmp_path, FRAMES, single=True)
    lines = []
    for number, frame_id in enumerate(FRAMES):
        for entry in json.loads((kitti / "masks" / f"{frame_id}.json").read_text()):
            if entry["image"] == "left":
                size, counts = entry["segmentation"]["size"], entry["segmentation"]["counts"]
                lines.append(f"{number} {1003 + entry['instance_id']} 1 {size[0]} {size[1]} {counts}")
    lines.append(f"0 10000 10 {size[0]} {size[1]} {counts}")
    write(tmp_path / "mots" / name, "\n".join(lines))
    whole = open_dataset("tracking", tmp_path, kitti / "detections", kitti / "masks").load("000001").detections
    for masks in (tmp_path / "mots", tmp_path / "mots" / name):
        dataset = open_dataset("tracking", tmp_path, kitti / "detections", masks, tracks=True)
        found = dataset.load("000001").detections
        assert found.mask_left.dense().equal(whole.mask_left.dense())
        assert not found.has_mask_right.any()
        assert found.track_id is not None
        assert found.track_id.tolist() == [3, 4]
        assert tmp_path / "mots" / name in dataset.input_files("000001").values()
    write(tmp_path / "mots" / name, "0 1003 1 120 160")
    with pytest.raises(DataFormatError, match=r"line 1: expected five whole numbers and run lengths, got 5 words"):
        open_dataset("tracking", tmp_path, kitti / "detections", tmp_path / "mots").load("000000")


def test_text_masks_of_several_sequences(kitti: Path, tmp_path: Path) -> None:
    write_sequence(kitti, tmp_path, FRAMES, single=False)
    write_tracked(kitti / "detections" / "data", FRAMES, tmp_path / "results" / f"{SEQUENCE}.txt")
    entry = json.loads((kitti / "masks" / f"{FRAMES[1]}.json").read_text())[0]["segmentation"]
    write(tmp_path / "mots" / f"{SEQUENCE}.txt", f"1 1007 1 {entry['size'][0]} {entry['size'][1]} {entry['counts']}")
    write(tmp_path / "mots" / "0099.txt", "nothing of this sequence")
    dataset = open_dataset("tracking", tmp_path, tmp_path / "results", tmp_path / "mots")
    assert [int(dataset.load(f"{SEQUENCE}_{name}").detections.has_mask_left.sum()) for name in FRAMES] == [0, 1]


def test_stereo2015(kitti: Path, tmp_path: Path, expected: LoadedFrame) -> None:
    write_stereo2015(kitti, tmp_path, FRAMES)
    detections, masks = renamed(kitti, tmp_path, ("000000_11", "000001"))
    put(masks / "000001.json", masks / "000001_11.json")
    dataset = open_dataset("stereo2015", tmp_path, detections, masks, dtype=torch.float64)
    assert dataset.frame_ids == ("000000_11", "000001_10")
    assert_same(dataset, "000001_10", expected)
    assert dataset.load("000001_10").frame.ground.source == ("file",)
    assert open_dataset("stereo2015", tmp_path, detections, masks, frames=[1]).frame_ids == ("000001_10",)
    assert dataset.load("000000_11").labels is None


def test_folder(kitti: Path, tmp_path: Path, expected: LoadedFrame) -> None:
    write_folder(kitti, tmp_path, FRAMES)
    dataset = open_dataset("folder", tmp_path, dtype=torch.float64)
    assert dataset.frame_ids == FRAMES
    assert_same(dataset, "000001", expected)
    assert instances(dataset, dataset.load("000001"))[0] == [0, 2]
    assert open_dataset("folder", tmp_path, frames=[1]).frame_ids == ("000001",)


def test_a_mask_stays_with_its_object_wherever_it_is(kitti: Path, tmp_path: Path) -> None:
    write_folder(kitti, tmp_path, FRAMES)
    path = tmp_path / "frames" / "000000.json"
    content = json.loads(path.read_text())
    first, _, second = content["objects"]
    for side in ("mask_left", "mask_right"):
        first[side], second[side] = second[side], first[side]
    path.write_text(json.dumps(content))
    folder = open_dataset("folder", tmp_path)
    swapped, as_before = (folder.load(frame_id) for frame_id in FRAMES)
    assert instances(folder, swapped)[0] == [0, 2]
    assert torch.equal(swapped.detections.mask_left.dense(), as_before.detections.mask_left.dense().flip(0))


@pytest.mark.parametrize("layout", ["raw", "tracking", "stereo2015", "folder"])
def test_another_layout_is_refused_with_the_cure(layout: LayoutName, kitti: Path) -> None:
    with pytest.raises(DataFormatError, match=r"--layout|check the path"):
        open_dataset(layout, kitti, kitti / "detections")


def test_wrong_words_and_folders_that_are_not_there(kitti: Path, tmp_path: Path) -> None:
    detections = kitti / "detections"
    cases: list[tuple[str, Path, Path | None, str]] = [
        ("coco", kitti, None, "layout: expected one of kitti, raw, tracking, odometry, stereo2015, folder, got 'coco'"),
        ("kitti", kitti, None, "detections: expected a folder of detections for the layout 'kitti', got none"),
        ("kitti", kitti / "masks", detections, "holds no image_2, training/image_2 or testing/image_2 in KITTI's"),
        ("odometry", kitti, detections, r"holds no \[dataset/\]sequences/NN/image_2 as KITTI's odometry data"),
        ("kitti", kitti, kitti / "nowhere", "nowhere: is no folder of detections"),
        ("kitti", kitti, tmp_path, r"frames: expected at least one detection file NNNNNN\.txt in"),
    ]
    for layout, root, given, message in cases:
        with pytest.raises((InputError, DataFormatError), match=message):
            open_dataset(layout, root, given)  # type: ignore[arg-type]
    # Not the frames 0, 0, 0, 0, 0 and 1.
    with pytest.raises(InputError, match=r"frames: expected a list of ids or numbers, got '000001'"):
        open_dataset("kitti", kitti, detections, frames="000001")
