"""This module writes frames in the folder layout of KITTI's object benchmark."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from demo_scene.camera import CameraPose, projection
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
    training = root / "training"
    for folder, image in (("image_2", frame.image_left), ("image_3", frame.image_right)):
        _write_png(training / folder / f"{name}.png", image)
    write_text(training / "planes" / f"{name}.txt", plane_text(frame.layout.camera))
    masks = mask_entries(frame.instance_left, "left") + mask_entries(frame.instance_right, "right")
    write_text(training / "masks" / f"{name}.json", json.dumps(masks))
    write_text(training / "meta" / f"{name}.json", json.dumps(scene_description(frame.layout), indent=1) + "\n")
    write_text(training / "calib" / f"{name}.txt", calibration_text())
    write_text(training / "label_2" / f"{name}.txt", "".join(label_line(x) + "\n" for x in frame.labels.values()))
    detections = root / "detections" / "noisy_stereo" / "data" / f"{name}.txt"
    write_text(detections, "".join(result_line(x, 0.9) + "\n" for x in frame.detections.values()))


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
