"""This module fits shapes to the LiDAR scans of a data set, in boxes of any origin, without images."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from directshape_torch.batch.fit_shape import ShapeFit, fit_shape
from directshape_torch.batch.frame_outputs import refined_boxes
from directshape_torch.files.array_files import write_npz
from directshape_torch.files.atomic_files import write_bytes
from directshape_torch.geometry.box_formats import poses_to_boxes
from directshape_torch.io.kitti_labels import poses_cam
from directshape_torch.io.result_files import write_result_text
from directshape_torch.io.run_folder import result_path, shapes_path
from directshape_torch.io.stereo_dataset import StereoDataset
from directshape_torch.shape.shape_prior import ShapePrior


def fit_scan(dataset: StereoDataset, frame_id: str, out_dir: Path | str, prior: ShapePrior | None = None) -> ShapeFit:
    """Fit a pose and a shape, in the left camera frame, to the points in each box of a frame.

    Write `data/ID.txt` (result lines), `shapes/ID.npz` and `meshes/ID_LINE.ply`, the meshes in the camera frame.

    Args:
        dataset: data set opened with `lidar_dir` (`open_dataset`); its detections, which may be labels, are the boxes.
        frame_id: one of `dataset.frame_ids`.
        out_dir: folder of the files.
        prior: shape prior. Default: the bundled one.

    Raises:
        InputError: the data set has no scans.
        DataFormatError: a file is missing or damaged.
    """
    from trimesh.exchange.ply import export_ply

    points, camera = dataset.scan(frame_id)
    objects = dataset.objects(frame_id)
    rows = [row for row, each in enumerate(objects) if each.type in dataset.classes and each.has_box_3d]
    chosen = [objects[row] for row in rows]
    hwl = torch.tensor([each.hwl for each in chosen], dtype=torch.float64).reshape(-1, 3)
    fit = fit_shape(points, poses_to_boxes(poses_cam(chosen, camera.t_cam_ref[0]), hwl, "kitti"), "kitti", prior)
    fit = replace(fit, cars=replace(fit.cars, t_cam_ref=camera.t_cam_ref.expand(len(rows), 3)))
    write_result_text(result_path(out_dir, frame_id), objects, refined_boxes(fit.cars.boxes(), fit.cars.refined, rows))
    arrays = {
        "T_cam_obj": fit.cars.T_cam_obj.numpy(),
        "codes": fit.cars.code.numpy(),
        "num_points": fit.num_points.numpy(),
        "distances_before_m": fit.distance_before_m.numpy(),
        "distances_after_m": fit.distance_after_m.numpy(),
        "input_lines": np.array([each.line_number for each in chosen], dtype=np.int64),
        "statuses": np.array([each.name for each in fit.cars.status], dtype=np.str_),
    }
    write_npz(shapes_path(out_dir, frame_id), arrays)
    for car in fit.cars.refined.nonzero()[:, 0].tolist():
        path = Path(out_dir) / "meshes" / f"{frame_id}_{chosen[car].line_number}.ply"
        write_bytes(path, export_ply(fit.cars.mesh(car)))
    return fit
