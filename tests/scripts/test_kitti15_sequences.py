"""Frames of one drive become a sequence whose cars have the numbers of their masks."""

from __future__ import annotations

import json
from pathlib import Path

import kitti15_sequences

from directshape_torch.io.kitti_labels import read_tracking_objects

CAR, FAR, VAN = (
    f"{kind} 0 0 0 {u} 20 {u + 40} 50 1.5 1.6 4 1 1.6 20 0" for kind, u in (("Car", 0), ("Car", 90), ("Van", 0))
)


def write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def write_frame(data: Path, name: str, masks: dict[int, int]) -> None:
    entries = [{"category_id": 3, "instance_id": k, "bbox": [u, 22, 38, 28]} for k, u in masks.items()]
    write(data / f"training/masks/{name}.json", json.dumps(entries))
    write(data / f"training/label_2/{name}.txt", f"{VAN}\n{CAR}\n{FAR}\n")
    write(data / f"detections/some/data/{name}.txt", f"{FAR} 0.9\n")
    for file in ("image_2/{}.png", "image_3/{}.png", "calib/{}.txt"):
        write(data / "training" / file.format(name), name)


def test_cars_are_numbered_over_the_frames_of_a_drive(tmp_path: Path) -> None:
    data, out = tmp_path / "data", tmp_path / "out"
    write_frame(data, "300007", {1004: 1})
    write_frame(data, "100007", {1004: 91, 1003: 2})
    write_frame(data, "100046", {1001: 1})
    rows = ["300007,000007_11,2011_09_26_drive_0009_sync", "100007,000007,2011_09_26_drive_0009_sync"]
    rows.append("100046,000046,2011_09_26_drive_0014_sync")
    write(data / "frames.csv", "\n".join(["name,stereo2015_id,drive", *rows]))
    assert kitti15_sequences.main(["--data", str(data), "--out", str(out)]) == 0
    # No car of the other drive is seen twice; a scene's second image comes after its first.
    assert [path.name for path in (out / "image_02").iterdir()] == ["0009"]
    assert [(out / f"image_03/0009/00000{k}.png").read_text() for k in (0, 1)] == ["100007", "300007"]
    labels = read_tracking_objects(out / "label_02/0009.txt")
    assert [[each.track_id for each in labels[frame]] for frame in (0, 1)] == [
        [100_000, 1003, 1004],
        [200_000, 1004, 200_002],
    ]
    detections = read_tracking_objects(out / "detections/some/0009.txt")
    assert [detections[frame][0].track_id for frame in (0, 1)] == [1004, 200_000]
    assert detections[0][0].score == 0.9
