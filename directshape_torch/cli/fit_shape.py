"""`directshape fit-shape`: fit shapes to LiDAR points in boxes.

Fit a pose and a shape to the LiDAR points in each box of a data set, without images. The results are OUT/data/ID.txt
(KITTI result lines, for 'directshape compare'), OUT/shapes/ID.npz (poses, codes, statuses, distances of the points) and
OUT/meshes/ID_LINE.ply in the left camera frame. In Python `fit_shape` takes points and boxes of any origin. The exit
code is 0, or 2 for wrong usage or input.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from directshape_torch.batch.fit_shape import ShapeFit, fit_shape
from directshape_torch.batch.frame_outputs import refined_boxes
from directshape_torch.cli.options import add_layout_options
from directshape_torch.errors import InputError
from directshape_torch.files.array_files import write_npz
from directshape_torch.files.atomic_files import check_folder, write_bytes
from directshape_torch.geometry.box_formats import poses_to_boxes
from directshape_torch.io.kitti_labels import poses_cam
from directshape_torch.io.result_files import write_result_text
from directshape_torch.io.run_folder import result_path, shapes_path
from directshape_torch.io.stereo_dataset import StereoDataset, open_dataset
from directshape_torch.shape.load_prior import load_prior
from directshape_torch.shape.shape_prior import ShapePrior


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of a data set with scans, boxes and shapes."""
    add_layout_options(parser, required=True)
    parser.add_argument("--lidar", type=Path, required=True, metavar="DIR", help="scans of the data set, NNNNNN.bin")
    parser.add_argument("--boxes", type=Path, required=True, metavar="DIR", help="folder of detections or labels")
    parser.add_argument("--prior", metavar="FILE|NAME", default="pca", help="shapes (default: %(default)s)")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the results")


def run(args: argparse.Namespace) -> int:
    """Read the scans and boxes, fit, write and print."""
    check_folder("out", args.out)
    options = {"frames": args.frames, "classes": args.classes, "lidar_dir": args.lidar}
    dataset, prior = open_dataset(args.layout, args.data, args.boxes, **options), load_prior(args.prior)
    scanned = [each for each in dataset.frame_ids if dataset.input_files(each)["lidar"].is_file()]
    if not scanned:
        raise InputError("--lidar", f"a scan of frame {dataset.frame_ids[0]} or another", f"none in {args.lidar}")
    fits = []
    for frame_id in scanned:
        fits.append(fit_scan(dataset, frame_id, args.out, prior))
        print(f"{frame_id}  {_summary(fits[-1:])}", flush=True)
    if len(scanned) < len(dataset.frame_ids):
        print(f"no scan of {len(dataset.frame_ids) - len(scanned)} frames in {args.lidar}")
    print(f"all     {_summary(fits)}\nresults {args.out}")
    return 0


def fit_scan(dataset: StereoDataset, frame_id: str, out_dir: Path, prior: ShapePrior) -> ShapeFit:
    """Fit shapes, in the left camera frame, to the points in the boxes of a frame, and write its files."""
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
        path = out_dir / "meshes" / f"{frame_id}_{chosen[car].line_number}.ply"
        write_bytes(path, export_ply(fit.cars.mesh(car)))
    return fit


def _summary(fits: Sequence[ShapeFit]) -> str:
    """Text with the number of fitted cars and the mean distance of their points to the surfaces."""
    refined = torch.cat([fit.cars.refined for fit in fits])
    before, after = (
        float(torch.cat([getattr(fit, f"distance_{when}_m") for fit in fits])[refined].mean())
        for when in ("before", "after")
    )
    means = f", points {before:.3f} -> {after:.3f} m from the surface" if refined.any() else ""
    return f"{int(refined.sum())} of {len(refined)} cars fitted{means}"
