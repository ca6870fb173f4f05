"""Shapes fitted to the LiDAR scans of a data set, in boxes of any origin; no image is read."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from directshape_torch.batch.fit_shape import ShapeFit, fit_shape
from directshape_torch.files import atomic_files
from directshape_torch.geometry.box_formats import poses_to_boxes
from directshape_torch.io.kitti_labels import KittiObject, poses_cam
from directshape_torch.io.result_files import write_result_text
from directshape_torch.io.run_folder import mesh_path, result_path, shapes_path
from directshape_torch.io.stereo_dataset import StereoDataset
from directshape_torch.shape.shape_prior import ShapePrior


@dataclass(frozen=True)
class ScanFit:
    """The cars of a frame, fitted to its scan."""

    frame_id: str
    objects: list[KittiObject]  # all lines of its file of boxes
    rows: list[int]  # N numbers, which of them were fitted
    fit: ShapeFit  # of these, in the left camera frame


def fit_scan(dataset: StereoDataset, frame_id: str, prior: ShapePrior | None = None) -> ScanFit:
    """Fit a pose and a shape to the points in each box of a frame.

    Args:
        dataset: opened with `lidar_dir` (`open_dataset`); its detections are the boxes, labels among them.
        frame_id: one of `dataset.frame_ids`.
        prior: the shapes; default the bundled ones.

    Raises:
        InputError: a data set without scans.
        DataFormatError: a file is missing or damaged.
    """
    points, camera = dataset.scan(frame_id)
    objects = dataset.objects(frame_id)
    rows = [row for row, each in enumerate(objects) if each.type in dataset.classes and each.has_box_3d]
    chosen = [objects[row] for row in rows]
    hwl = torch.tensor([each.hwl for each in chosen], dtype=torch.float64).reshape(-1, 3)
    boxes = poses_to_boxes(poses_cam(chosen, camera.t_cam_ref[0]), hwl, "kitti")
    fit = fit_shape(points, boxes, "kitti", prior)
    cars = replace(fit.cars, t_cam_ref=camera.t_cam_ref.expand(len(rows), 3))
    return ScanFit(frame_id, objects, rows, replace(fit, cars=cars))


def write_scan_fit(out_dir: Path, scan: ScanFit) -> None:
    """Write `data/ID.txt` (result lines), `shapes/ID.npz` and `meshes/ID_LINE.ply`, the latter in the camera frame."""
    from trimesh.exchange.ply import export_ply

    cars, refined = scan.fit.cars, scan.fit.cars.refined.tolist()
    boxes = cars.boxes()
    columns = (boxes.alpha[:, None], boxes.dimensions_hwl, boxes.location_ref, boxes.rotation_y[:, None])
    lines = torch.cat(columns, dim=1).tolist()
    changed = {row: lines[car] for car, row in enumerate(scan.rows) if refined[car]}
    write_result_text(result_path(out_dir, scan.frame_id), scan.objects, changed)
    numbers = np.array([scan.objects[row].line_number for row in scan.rows], dtype=np.int64)
    atomic_files.write_npz(shapes_path(out_dir, scan.frame_id), scan.fit.arrays("cam", input_lines=numbers))
    for car, row in enumerate(scan.rows):
        if refined[car]:
            path = mesh_path(out_dir, scan.frame_id, scan.objects[row].line_number, "ply")
            atomic_files.write_bytes(path, export_ply(cars.mesh(car)))
