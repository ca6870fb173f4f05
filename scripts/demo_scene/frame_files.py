"""This module writes frames in the folder layouts of KITTI's object and tracking benchmarks."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from demo_scene.camera import T_CAM_REF, CameraPose, projection
from demo_scene.labels import CarLabel, label_line, result_line
from demo_scene.layout import SceneLayout
from demo_scene.surfaces import Indices, Picture
from directshape_torch.files.atomic_files import write_text

_COCO_CAR = 3


@dataclass(frozen=True)
class Frame:
    """A `Frame` has everything that is written for a frame; instance maps have car numbers, and -1 elsewhere."""

    layout: SceneLayout
    image_left: Picture
    image_right: Picture
    instance_left: Indices
    instance_right: Indices
    labels: dict[int, CarLabel]  # of the visible cars, by the car's number
    detections: dict[int, CarLabel]


def write_frame(root: Path, name: str, frame: Frame) -> None:
    """Write images, calibration, labels, plane, masks, detections and the scene's description under `root`."""
    _write_views(root, ("image_2", "image_3"), name, frame, {})
    training = root / "training"
    write_text(training / "calib" / f"{name}.txt", calibration_text())
    write_text(training / "label_2" / f"{name}.txt", "".join(label_line(x) + "\n" for x in frame.labels.values()))
    detections = root / "detections" / "noisy_stereo" / "data" / f"{name}.txt"
    write_text(detections, "".join(result_line(x, 0.9) + "\n" for x in frame.detections.values()))


def write_sequence(root: Path, name: str, frames: Sequence[Frame], interval_s: float) -> None:
    """Write frames of one scene in the layout of KITTI's tracking benchmark; a car's number is its track.

    Further files are `poses/NAME.txt` (poses of camera 0 relative to the first frame, rows of 12 as in KITTI's odometry
    benchmark) and `times/NAME.txt` (seconds).
    """
    training = root / "training"
    for number, frame in enumerate(frames):
        when = {"time_s": number * interval_s}
        _write_views(root, ("image_02", "image_03"), f"{name}/{number:06d}", frame, when)
    lines = [(f"{n} {k}", frame.labels[k], frame.detections[k]) for n, frame in enumerate(frames) for k in frame.labels]
    write_text(training / "calib" / f"{name}.txt", calibration_text())
    write_text(training / "poses" / f"{name}.txt", "".join(pose_lines([f.layout.camera for f in frames])))
    times = "".join(f"{number * interval_s:.3f}\n" for number in range(len(frames)))
    write_text(training / "times" / f"{name}.txt", times)
    write_text(training / "label_02" / f"{name}.txt", "".join(f"{n} {label_line(x)}\n" for n, x, _ in lines))
    found = "".join(f"{n} {result_line(x, 0.9)}\n" for n, _, x in lines)
    write_text(root / "detections" / "noisy_stereo" / f"{name}.txt", found)


def _write_views(root: Path, folders: tuple[str, str], stem: str, frame: Frame, when: dict[str, Any]) -> None:
    """Write the files of a frame that both layouts have: images, plane, masks and description."""
    training = root / "training"
    for folder, image in zip(folders, (frame.image_left, frame.image_right), strict=True):
        _write_png(training / folder / f"{stem}.png", image)
    write_text(training / "planes" / f"{stem}.txt", plane_text(frame.layout.camera))
    masks = mask_entries(frame.instance_left, "left") + mask_entries(frame.instance_right, "right")
    write_text(training / "masks" / f"{stem}.json", json.dumps(masks))
    description = json.dumps({**when, **scene_description(frame.layout)}, indent=1)
    write_text(training / "meta" / f"{stem}.json", description + "\n")


def pose_lines(cameras: Sequence[CameraPose]) -> list[str]:
    """Rows of 12 numbers of `T_first_ref` for each camera 0."""
    T_ref_cam = np.eye(4)
    T_ref_cam[:3, 3] = -T_CAM_REF
    T_ref_road = [T_ref_cam @ camera.T_cam_road for camera in cameras]
    return [_numbers((T_ref_road[0] @ np.linalg.inv(T))[:3].ravel()) + "\n" for T in T_ref_road]


def calibration_text() -> str:
    """KITTI's object calibration file; the rows of laser scanner and IMU, which do not exist, only change axes."""
    lines = [f"{name}: " + _numbers(projection(name).ravel()) for name in ("P0", "P1", "P2", "P3")]
    lines.append("R0_rect: " + _numbers(np.eye(3).ravel()))
    axes = np.array([[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0]])
    lines.append("Tr_velo_to_cam: " + _numbers(axes.ravel()))
    lines.append("Tr_imu_to_velo: " + _numbers(np.eye(4)[:3].ravel()))
    return "\n".join(lines) + "\n"


def plane_text(camera: CameraPose) -> str:
    """The ground plane in ref, in the form of AVOD's plane files."""
    return "# Plane\nWidth 4\nHeight 1\n" + _numbers(camera.ground_plane_ref) + "\n"


def _numbers(values: np.ndarray[Any, np.dtype[np.float64]]) -> str:
    return " ".join(f"{v:.12e}" for v in values)


def mask_entries(instance: Indices, side: str) -> list[dict[str, Any]]:
    """COCO results for each car with a pixel in the map; `instance_id` is 1000 + label line, from 1."""
    from pycocotools import mask as coco

    entries = []
    for number in np.unique(instance[instance >= 0]):
        rle = coco.encode(np.asfortranarray(instance == number, dtype=np.uint8))
        entries.append(
            {
                "image": side,
                "instance_id": 1001 + int(number),
                "category_id": _COCO_CAR,
                "bbox": [float(x) for x in coco.toBbox(rle)],
                "score": 1.0,
                "segmentation": {"size": [int(n) for n in rle["size"]], "counts": rle["counts"].decode("ascii")},
            }
        )
    return entries


def scene_description(layout: SceneLayout) -> dict[str, Any]:
    """Seed, camera, sun, and the exact pose, measures and paint of each car."""
    return {
        "seed": layout.seed,
        "camera_height_m": layout.camera.height_m,
        "camera_pitch_rad": layout.camera.pitch_rad,
        "camera_roll_rad": layout.camera.roll_rad,
        "sun_elevation_rad": layout.sun_elevation_rad,
        "sun_azimuth_rad": layout.sun_azimuth_rad,
        "cars": [
            {
                "T_cam_obj": (layout.camera.T_cam_road @ car.T_road_obj).tolist(),
                "paint_rgb": list(car.paint_rgb),
                "metallic": car.metallic,
                "parameters": asdict(car.parameters),
            }
            for car in layout.cars
        ],
    }


def _write_png(path: Path, picture: Picture) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    encoded, data = cv2.imencode(".png", picture[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])
    if not encoded:
        raise OSError(f"{path}: OpenCV could not encode the picture")
    path.write_bytes(data.tobytes())
