"""Cars keep their number over the frames of a sequence: from the detections, the masks, or by association."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.layouts import SEQUENCE, write, write_folder, write_sequence, write_tracked

from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.files.text_files import Line
from directshape_torch.io.frame_collation import collate
from directshape_torch.io.kitti_labels import KittiObject, parse_object, read_tracking_objects
from directshape_torch.io.stereo_dataset import open_dataset
from directshape_torch.io.track_association import associate

FRAMES = ("000000", "000001")


def test_tracks_of_a_result_file_reach_the_detections(kitti: Path, tmp_path: Path) -> None:
    write_sequence(kitti, tmp_path, FRAMES, single=True)
    write_tracked(kitti / "detections" / "data", FRAMES, tmp_path / "results" / f"{tmp_path.name}.txt", (7, -1, 3))
    dataset = open_dataset("tracking", tmp_path, tmp_path / "results", kitti / "masks", tracks=True)
    _, detections = collate([dataset.load(frame_id) for frame_id in FRAMES])
    assert detections.track_id.tolist() == [7, 3, 7, 3]
    unasked = open_dataset("tracking", tmp_path, tmp_path / "results", kitti / "masks")
    assert unasked.load(FRAMES[0]).detections.track_id is None


@pytest.mark.parametrize("box_2d", [None, "-1 -1 -1 -1", "0 0 5 5"])
def test_cars_without_numbers_are_associated(kitti: Path, tmp_path: Path, box_2d: str | None) -> None:
    write_sequence(kitti, tmp_path, FRAMES, single=True)
    for name in FRAMES:
        lines = [line.split() for line in (kitti / "detections" / "data" / f"{name}.txt").read_text().splitlines()]
        text = "\n".join(" ".join([*w[:4], *(w[4:8] if box_2d is None else [box_2d]), *w[8:]]) for w in lines)
        write(tmp_path / "detected" / f"{name}.txt", text)
    dataset = open_dataset("tracking", tmp_path, tmp_path / "detected", kitti / "masks", tracks=True)
    first, second = (dataset.load(frame_id).detections.track_id for frame_id in FRAMES)
    # Both frames show the same cars; the pedestrian's line lies between them.
    assert first.tolist() == second.tolist() == [0, 2]


def test_instances_of_mots_are_tracks(kitti: Path, tmp_path: Path) -> None:
    write_sequence(kitti, tmp_path, FRAMES, single=True)
    for name in FRAMES:
        masks = (
            open_dataset("kitti", kitti, kitti / "detections", kitti / "masks").load(name).detections.mask_left.dense()
        )
        ids = 1008 * (masks[0] > 0.5) + 1005 * ((masks[1] > 0.5) & (masks[0] <= 0.5))
        path = tmp_path / "mots" / "instance_02" / f"{name}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), ids.numpy().astype(np.uint16))
    dataset = open_dataset("tracking", tmp_path, kitti / "detections", tmp_path / "mots", tracks=True)
    track_id = dataset.load(FRAMES[1]).detections.track_id
    assert track_id.tolist() == [8, 5]


def test_objects_of_a_folder_carry_their_track(kitti: Path, tmp_path: Path) -> None:
    write_folder(kitti, tmp_path, FRAMES)
    path = tmp_path / "frames" / f"{FRAMES[0]}.json"
    text = path.read_text()
    path.write_text(text.replace('"class": "Car"', '"track_id": 4, "class": "Car"', 1))
    track_id = open_dataset("folder", tmp_path, tracks=True).load(FRAMES[0]).detections.track_id
    assert track_id.tolist() == [4, -1]
    path.write_text(text.replace('"class": "Car"', '"track_id": 4.5, "class": "Car"', 1))
    with pytest.raises(DataFormatError, match=r"objects\[0\].track_id: expected int, got 4\.5"):
        open_dataset("folder", tmp_path, tracks=True).load(FRAMES[0])


def test_tracks_of_two_sequences_are_different_cars(kitti: Path, tmp_path: Path) -> None:
    write_sequence(kitti, tmp_path, FRAMES, single=True)
    write_tracked(kitti / "detections" / "data", FRAMES, tmp_path / "results" / f"{tmp_path.name}.txt", (7, -1, 3))
    dataset = open_dataset("tracking", tmp_path, tmp_path / "results", kitti / "masks", tracks=True)
    first, second = (dataset.load(frame_id) for frame_id in FRAMES)
    _, detections = collate([replace(first, sequence="0001"), replace(second, sequence="0002")])
    assert len(set(detections.track_id.tolist())) == 4


def test_frames_by_themselves_have_no_tracks(kitti: Path) -> None:
    with pytest.raises(InputError, match="tracks: expected a layout of sequences"):
        open_dataset("kitti", kitti, kitti / "detections", kitti / "masks", tracks=True)


def test_a_line_without_a_track_is_refused(tmp_path: Path) -> None:
    path = tmp_path / f"{SEQUENCE}.txt"
    write(path, f"0 x {_line(100, 20.0)}")
    with pytest.raises(DataFormatError, match="line 1: expected 17 or 18 columns beginning with the numbers"):
        read_tracking_objects(path)


def _line(u: float, z: float, kind: str = "Car") -> str:
    return f"{kind} 0 0 0 {u} 150 {u + 60} 200 1.5 1.6 3.9 0 1.6 {z} 0"


def _car(u: float, z: float = 20.0, kind: str = "Car") -> KittiObject:
    return parse_object("f", Line(1, _line(u, z, kind), ""))


def test_motion_keeps_cars_apart_that_pass_each_other() -> None:
    # Overlap alone would exchange them where they meet.
    us = [(100 + 30 * k, 250 - 30 * k) for k in range(5)]
    assert associate([[_car(a), _car(b)] for a, b in us]) == [[0, 1]] * 5


def test_a_car_is_found_again_after_two_frames_and_not_after_three() -> None:
    seen = [_car(100)]
    assert associate([seen, [], [], seen]) == [[0], [], [], [0]]
    assert associate([seen, [], [], [], seen])[-1] == [1]


def test_another_depth_or_type_is_another_car() -> None:
    assert associate([[_car(100)], [_car(100, z=31.0)]]) == [[0], [1]]
    assert associate([[_car(100)], [_car(100, kind="Van")]]) == [[0], [1]]
    assert associate([[_car(100, z=-1000.0)]]) == [[-1]]
