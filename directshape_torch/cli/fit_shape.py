"""`directshape fit-shape`: fit shapes to LiDAR points in boxes.

Fit a pose and a shape to the points in each box, without images. For one cloud (--points, --boxes FILE) the results are
in its own frame: OUT/boxes.txt (seven numbers in each line, in the convention of the input), OUT/shapes.npz (poses,
codes, statuses, distances of the points) and OUT/meshes/NNN.ply. For a data set (--data, --lidar, --boxes DIR) they are
OUT/data/ID.txt (KITTI result lines, for 'directshape compare'), OUT/shapes/ID.npz and OUT/meshes/ID_LINE.ply in the
left camera frame. The exit code is 0, or 2 for wrong usage or input.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import get_args

import numpy as np
import torch
from numpy.typing import NDArray

from directshape_torch.batch.fit_shape import ShapeFit, fit_shape
from directshape_torch.batch.scan_fits import fit_scan
from directshape_torch.cli.options import add_layout_options
from directshape_torch.errors import InputError
from directshape_torch.files.array_files import write_npz
from directshape_torch.files.atomic_files import check_folder, write_bytes, write_text
from directshape_torch.files.text_files import finite_numbers, read_lines
from directshape_torch.geometry.box_formats import BoxFormat
from directshape_torch.io.stereo_dataset import open_dataset
from directshape_torch.io.velodyne import read_points
from directshape_torch.shape.load_prior import load_prior


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of a cloud or a data set with scans, boxes and shapes."""
    where = parser.add_mutually_exclusive_group(required=True)
    where.add_argument(
        "--points", type=Path, metavar="FILE", help="points.npy (P, 3 or more), or KITTI's velodyne .bin"
    )
    where.add_argument("--lidar", type=Path, metavar="DIR", help="scans of a data set, NNNNNN.bin; needs --data")
    parser.add_argument(
        "--boxes",
        type=Path,
        required=True,
        metavar="FILE|DIR",
        help="of --points: seven numbers a line, in its frame; of --lidar: a folder of detections or labels",
    )
    add_layout_options(parser)
    parser.add_argument(
        "--convention",
        choices=get_args(BoxFormat),
        default="mmdet3d_lidar",
        help="of the boxes of --points: order, centre and heading (default: %(default)s)",
    )
    parser.add_argument("--prior", metavar="FILE|NAME", default="pca", help="shapes (default: %(default)s)")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the results")


def run(args: argparse.Namespace) -> int:
    """Read the points and boxes, fit, write and print."""
    check_folder("out", args.out)
    return _fit_cloud(args) if args.lidar is None else _fit_scans(args)


def _fit_scans(args: argparse.Namespace) -> int:
    if args.data is None:
        raise InputError("--data", "the folder of the data set that the scans belong to", "none", "--data ROOT")
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


def _summary(fits: Sequence[ShapeFit]) -> str:
    """Text with the number of fitted cars and the mean distance of their points to the surfaces."""
    refined = torch.cat([fit.cars.refined for fit in fits])
    before, after = (
        float(torch.cat([getattr(fit, f"distance_{when}_m") for fit in fits])[refined].mean())
        for when in ("before", "after")
    )
    means = f", points {before:.3f} -> {after:.3f} m from the surface" if refined.any() else ""
    return f"{int(refined.sum())} of {len(refined)} cars fitted{means}"


def _fit_cloud(args: argparse.Namespace) -> int:
    from trimesh.exchange.ply import export_ply

    points, boxes = torch.from_numpy(read_points(args.points)), torch.from_numpy(read_boxes(args.boxes))
    fit = fit_shape(points, boxes, args.convention, load_prior(args.prior))
    cars = fit.cars
    fitted = cars.to_boxes(args.convention, T_cam_boxes=torch.eye(4, dtype=boxes.dtype))
    (args.out / "meshes").mkdir(parents=True, exist_ok=True)
    write_text(args.out / "boxes.txt", "".join(" ".join(f"{x:.4f}" for x in box) + "\n" for box in fitted.tolist()))
    write_npz(args.out / "shapes.npz", fit.arrays("points"))
    for row, status in enumerate(cars.status):
        before, after = float(fit.distance_before_m[row]), float(fit.distance_after_m[row])
        count = int(fit.num_points[row])
        found = f"{count} points, {before:.3f} -> {after:.3f} m" if count else "no points in this box"
        print(f"car {row}: {found}, {status.name}")
        if status.is_refined:
            write_bytes(args.out / "meshes" / f"{row:03d}.ply", export_ply(cars.mesh(row)))
    print(f"results  {args.out}")
    return 0


def read_boxes(path: Path) -> NDArray[np.float64]:
    """Boxes (B, 7) of a text file, seven numbers in each line.

    Raises:
        DataFormatError: the file cannot be read, or a line has another content.
    """
    cure = "write x y z, three sizes and the heading, metres and radians"
    rows = [finite_numbers(path, line, 7, cure=cure) for line in read_lines(path)]
    return np.array(rows, dtype=np.float64).reshape(-1, 7)
