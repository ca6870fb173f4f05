"""This module writes a tiny ray-cast street in KITTI's layout, with exact labels and masks and noisy detections."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.files.atomic_files import write_png
from directshape_torch.geometry.box3d import alpha_from_kitti, rotation_y_from_pose
from directshape_torch.scene.detections import Detections
from directshape_torch.shape.pca_prior import PCAShapePrior
from helpers.ellipsoids import ellipsoid_prior
from helpers.synthetic_scene import TWO_CARS, Street, disturbed, street

FRAMES = ("000000", "000001", "000002")
SIX_FRAMES = tuple(f"{number:06d}" for number in range(6))
PEDESTRIAN = "Pedestrian  -1 -1 0.50 1 20 9.0 60 1.80 0.60 0.60 -4.00 1.65 9.00 0.10 0.4"
CODE = ((0.8, -0.5, 0.6), (-0.7, 0.4, 0.5))


def write_data_set(root: Path, frame_ids: tuple[str, ...] = FRAMES) -> PCAShapePrior:
    """Write frames of two cars with different detections, and `root/prior.safetensors` with the cars' shapes."""
    prior = ellipsoid_prior()
    prior.save(root / "prior.safetensors")
    scene = street(prior, *TWO_CARS, code=torch.tensor(CODE, dtype=prior.mean.dtype))
    for number, frame_id in enumerate(frame_ids):
        write_frame(root, frame_id, scene, disturbed(scene.detections, 0.4, 0.1, seed=number))
    return prior


def input_options(root: Path, masks: bool = True) -> list[str]:
    """The input options of `directshape refine` for such a data set, on the CPU."""
    words = ["--data", root, "--detections", root / "detections", "--prior", root / "prior.safetensors"]
    return [*map(str, words + (["--masks", root / "masks"] if masks else [])), "--device", "cpu"]


def write_frame(root: Path, frame_id: str, scene: Street, detections: Detections) -> None:
    """Write the files of one frame under `root/training`, `root/masks` and `root/detections`."""
    training, frames = root / "training", scene.frames
    for folder, image in (("image_2", frames.images_left), ("image_3", frames.images_right)):
        write_png(training / folder / f"{frame_id}.png", (255 * image[0]).round().byte().permute(1, 2, 0).numpy())
    camera = frames.camera
    P2 = _projection(camera.K_left[0], camera.t_cam_ref[0])
    P3 = _projection(camera.K_right[0], camera.t_cam_ref[0] + camera.T_right_cam[0, :3, 3])
    _write(training / "calib" / f"{frame_id}.txt", f"P2: {_numbers(P2)}\nP3: {_numbers(P3)}\n")
    # n . x_cam + d = 0 with x_cam = x_ref + t.
    normal, offset = frames.ground.normal[0], frames.ground.offset[0]
    plane = torch.cat([normal, (offset + normal @ camera.t_cam_ref[0])[None]])
    _write(training / "planes" / f"{frame_id}.txt", f"# Plane\nWidth 4\nHeight 1\n{_numbers(plane)}\n")
    labels, lines = _lines(scene.detections, camera.t_cam_ref[0]), _lines(detections, camera.t_cam_ref[0])
    _write(training / "label_2" / f"{frame_id}.txt", "".join(f"{line}\n" for line in labels))
    scored = [f"{line} 0.{9 - k}" for k, line in enumerate(lines)]
    _write(root / "detections" / "data" / f"{frame_id}.txt", "\n".join([scored[0], PEDESTRIAN, *scored[1:]]) + "\n")
    _write(root / "masks" / f"{frame_id}.json", json.dumps(_masks(scene.detections)))


def write_disparity(path: Path, disparity: NDArray[np.floating]) -> None:
    """Write (H, W) pixels; NaN and values that are not positive become unknown, others are rounded to 1/256 pixel."""
    known = np.isfinite(disparity) & (disparity > 0)
    units = np.round(np.where(known, disparity, 0) * 256).clip(0, np.iinfo(np.uint16).max)
    write_png(path, units.astype(np.uint16))


def _lines(detections: Detections, t_cam_ref: Tensor) -> list[str]:
    location = detections.T_cam_obj[:, :3, 3] - t_cam_ref
    yaw = rotation_y_from_pose(detections.T_cam_obj)
    alpha = alpha_from_kitti(location, yaw)
    columns = [alpha[:, None], detections.box_2d, detections.dimensions_hwl, location, yaw[:, None]]
    return [f"Car 0.00 0 {' '.join(f'{value:.4f}' for value in row)}" for row in torch.cat(columns, dim=1).tolist()]


def _masks(detections: Detections) -> list[dict[str, object]]:
    from pycocotools import mask as coco

    entries: list[dict[str, object]] = []
    for side, masks in (("left", detections.mask_left), ("right", detections.mask_right)):
        for number, mask in enumerate(masks.dense().numpy()):
            rle = coco.encode(np.asfortranarray(mask > 0.5, dtype=np.uint8))
            segmentation = {"size": list(rle["size"]), "counts": rle["counts"].decode()}
            entries.append({"image": side, "instance_id": number, "category_id": 3, "segmentation": segmentation})
    return entries


def _projection(K: Tensor, t: Tensor) -> Tensor:
    return torch.cat([K, (K @ t)[:, None]], dim=1)


def _numbers(values: Tensor) -> str:
    return " ".join(repr(value) for value in values.flatten().tolist())


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
