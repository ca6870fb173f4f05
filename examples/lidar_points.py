"""LiDAR beside stereo, from tensors alone: points in the camera frame, and one more term.

    python examples/lidar_points.py

The bundled frame has no scan, so one is made up here: cars of the mean shape in their true boxes, seen from the camera.
Files of KITTI's velodyne need no program: `directshape refine --lidar DIR` (docs/extra_terms.md).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

import directshape_torch
from directshape_torch import Detections, DirectShapeRefiner, FrameBatch, RefinementResult
from directshape_torch.io.kitti_labels import poses_cam
from directshape_torch.io.stereo_dataset import open_dataset
from directshape_torch.terms.lidar import LidarPoints

ROOT = Path(directshape_torch.__file__).parent / "assets" / "demo"
NOISE_M = 0.025


def made_up_scan(frames: FrameBatch, truth: Detections) -> Tensor:
    """Points (1, P, 3) where the rays of some left pixels meet the cars, metres."""
    problem, state = DirectShapeRefiner().problem(frames, truth)
    hits = problem.prepare(state).hits
    owner = problem.masks.rays.owner[: len(hits.found), None].expand(hits.found.shape)[hits.found]
    T_cam_obj, points_obj = truth.T_cam_obj[owner], hits.points_obj[:, hits.found].T
    points_cam = (T_cam_obj[:, :3, :3] @ points_obj[..., None])[..., 0] + T_cam_obj[:, :3, 3]
    return (points_cam + NOISE_M * torch.randn(points_cam.shape, generator=torch.Generator().manual_seed(0)))[None]


def main() -> tuple[RefinementResult, RefinementResult, Tensor]:
    """Refine the bundled frame without and with points; also the true poses."""
    dataset = open_dataset("kitti", ROOT, ROOT / "detections" / "noisy_stereo", ROOT / "training" / "masks")
    loaded = dataset.load("000000")
    frames, detections = loaded.frame, loaded.detections
    T_cam_obj = poses_cam(loaded.labels or [], frames.camera.t_cam_ref[0])

    scan = made_up_scan(frames, replace(detections, T_cam_obj=T_cam_obj))
    without = DirectShapeRefiner()(frames, detections)
    refiner = DirectShapeRefiner(extra_terms=[LidarPoints()])
    result = refiner(replace(frames, points_cam=scan), detections)

    for car in range(len(detections)):
        before, after = (float((r.T_cam_obj[car] - T_cam_obj[car])[:3, 3].norm()) for r in (without, result))
        print(f"car {car}: {before:.2f} m from the truth without, {after:.2f} m with LiDAR")
    return without, result, T_cam_obj


if __name__ == "__main__":
    main()
