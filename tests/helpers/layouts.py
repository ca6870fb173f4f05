"""This module writes the frames of `helpers.kitti_folder` in the other layouts, with their own files."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from directshape_torch.io.folder_files import FOLDER_SCHEMA_VERSION
from directshape_torch.io.kitti_calibration import read_calibration, to_stereo_camera
from directshape_torch.io.kitti_labels import KittiObject, read_objects

DAY, DRIVE = "2011_09_26", "2011_09_26_drive_0005_sync"
SEQUENCE = "0005"


def put(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, target)


def write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def raw_calibration(kitti: Path, frame_id: str) -> str:
    """The text of `calib_cam_to_cam.txt`, with other names and with lines that are not numbers."""
    text = (kitti / "training" / "calib" / f"{frame_id}.txt").read_text()
    return "calib_time: 09-Jan-2012 13:57:47\n" + text.replace("P2:", "P_rect_02:").replace("P3:", "P_rect_03:")


def write_raw(kitti: Path, root: Path, frame_ids: tuple[str, ...]) -> Path:
    """Write a drive below its day and return the drive."""
    drive = root / DAY / DRIVE
    write(drive.parent / "calib_cam_to_cam.txt", raw_calibration(kitti, frame_ids[0]))
    for number, frame_id in enumerate(frame_ids):
        for folder, source in (("image_02", "image_2"), ("image_03", "image_3")):
            put(kitti / "training" / source / f"{frame_id}.png", drive / folder / "data" / f"{number:010d}.png")
        put(kitti / "training" / "planes" / f"{frame_id}.txt", drive / "planes" / f"{number:010d}.txt")
    return drive


def write_sequence(kitti: Path, root: Path, frame_ids: tuple[str, ...], single: bool) -> None:
    """Write one tracking sequence as a folder, or the benchmark's tree with one sequence."""
    base = root if single else root / "training"
    for number, frame_id in enumerate(frame_ids):
        for folder, source in (("image_02", "image_2"), ("image_03", "image_3"), ("planes", "planes")):
            ending = "txt" if folder == "planes" else "png"
            target = base / folder if single else base / folder / SEQUENCE
            put(kitti / "training" / source / f"{frame_id}.{ending}", target / f"{number:06d}.{ending}")
    labels = base / "label_02.txt" if single else base / "label_02" / f"{SEQUENCE}.txt"
    write_tracked(kitti / "training" / "label_2", frame_ids, labels)
    calibration = kitti / "training" / "calib" / f"{frame_ids[0]}.txt"
    put(calibration, base / "calib.txt" if single else base / "calib" / f"{SEQUENCE}.txt")


def write_odometry(kitti: Path, root: Path, frame_ids: tuple[str, ...], sequence: str = "04") -> None:
    """Write one sequence of the odometry benchmark with times and poses; its calibration has `Tr:`, no `R0_rect:`."""
    base = root / "sequences" / sequence
    for number, frame_id in enumerate(frame_ids):
        for folder in ("image_2", "image_3"):
            put(kitti / "training" / folder / f"{frame_id}.png", base / folder / f"{number:06d}.png")
        put(kitti / "training" / "planes" / f"{frame_id}.txt", base / "planes" / f"{number:06d}.txt")
    lines = (kitti / "training" / "calib" / f"{frame_ids[0]}.txt").read_text().splitlines()
    kept = [line for line in lines if line.startswith(("P0", "P1", "P2", "P3"))]
    write(base / "calib.txt", "\n".join([*kept, "Tr: 0 -1 0 0.1 0 0 -1 -0.2 1 0 0 -0.3", ""]))
    write(base / "times.txt", "".join(f"{0.1 * number:e}\n" for number in range(len(frame_ids))))
    rows = (f"1 0 0 0 0 1 0 0 0 0 1 {number}\n" for number in range(len(frame_ids)))
    write(root / "poses" / f"{sequence}.txt", "".join(rows))


def write_tracked(source: Path, frame_ids: tuple[str, ...], to: Path, tracks: Iterable[int] | None = None) -> None:
    """Write one file for the frames of a folder, with a track for each line, by default its number."""
    lines = [(source / f"{frame_id}.txt").read_text().splitlines() for frame_id in frame_ids]
    ids = list(range(max(map(len, lines))) if tracks is None else tracks)
    write(
        to, "".join(f"{k} {t} {line}\n" for k, frame in enumerate(lines) for t, line in zip(ids, frame, strict=False))
    )


def write_stereo2015(kitti: Path, root: Path, frame_ids: tuple[str, ...]) -> None:
    """Write both pairs of each scene, the second equal to the first."""
    for frame_id in frame_ids:
        for pair in ("10", "11"):
            for folder in ("image_2", "image_3"):
                put(
                    kitti / "training" / folder / f"{frame_id}.png",
                    root / "training" / folder / f"{frame_id}_{pair}.png",
                )
        write(root / "training" / "calib_cam_to_cam" / f"{frame_id}.txt", raw_calibration(kitti, frame_id))
        put(kitti / "training" / "planes" / f"{frame_id}.txt", root / "training" / "planes" / f"{frame_id}.txt")


def write_folder(kitti: Path, root: Path, frame_ids: tuple[str, ...]) -> None:
    """Write the plain folder, with boxes in left camera coordinates and with the masks beside them."""
    calibration = read_calibration(kitti / "training" / "calib" / f"{frame_ids[0]}.txt")
    camera = to_stereo_camera(calibration)
    t_cam_ref = [float(value) for value in camera.t_cam_ref[0].double()]
    rig = {
        "schema_version": FOLDER_SCHEMA_VERSION,
        "image_size_wh": [160, 120],
        "K_left": calibration.P2[:, :3].tolist(),
        "t_right_cam_m": [float(value) for value in camera.T_right_cam[0, :3, 3].double()],
    }
    write(root / "rig.json", json.dumps(rig))
    for frame_id in frame_ids:
        for side, source in (("left", "image_2"), ("right", "image_3")):
            put(kitti / "training" / source / f"{frame_id}.png", root / side / f"{frame_id}.png")
        objects = read_objects(kitti / "detections" / "data" / f"{frame_id}.txt")
        masks = json.loads((kitti / "masks" / f"{frame_id}.json").read_text())
        write(root / "frames" / f"{frame_id}.json", json.dumps(_frame(objects, masks, t_cam_ref)))


def _frame(objects: list[KittiObject], masks: list[dict[str, Any]], t_cam_ref: list[float]) -> dict[str, Any]:
    cars = [o for o in objects if o.type == "Car"]
    entries = [_entry(o, t_cam_ref) for o in objects]
    for mask in masks:
        # The cars' masks are numbered as the cars.
        row = objects.index(cars[mask["instance_id"]])
        entries[row][f"mask_{mask['image']}"] = mask["segmentation"]
    return {"schema_version": FOLDER_SCHEMA_VERSION, "objects": entries}


def _entry(found: KittiObject, t_cam_ref: list[float]) -> dict[str, Any]:
    return {
        "class": found.type,
        "score": found.score,
        "box_2d": list(found.box_2d),
        "dimensions_hwl_m": list(found.hwl),
        "bottom_center_m": [a + b for a, b in zip(found.location_ref, t_cam_ref, strict=True)],
        "rotation_y_rad": found.rotation_y,
    }
