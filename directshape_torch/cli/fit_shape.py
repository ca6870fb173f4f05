"""`directshape fit-shape`: fit shapes to LiDAR points in boxes.

Fit a pose and a shape to the LiDAR points in each box of a data set, without images. The results are OUT/data/ID.txt
(KITTI result lines, for 'directshape compare'), OUT/shapes/ID.npz (poses, codes, statuses, distances of the points) and
OUT/meshes/ID_LINE.ply in the left camera frame. In Python `fit_shape` takes points and boxes of any origin. The exit
code is 0, or 2 for wrong usage or input.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import torch

from directshape_torch.batch.fit_shape import ShapeFit
from directshape_torch.batch.scan_fits import fit_scan
from directshape_torch.cli.options import add_layout_options
from directshape_torch.errors import InputError
from directshape_torch.files.atomic_files import check_folder
from directshape_torch.io.stereo_dataset import open_dataset
from directshape_torch.shape.load_prior import load_prior


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


def _summary(fits: Sequence[ShapeFit]) -> str:
    """Text with the number of fitted cars and the mean distance of their points to the surfaces."""
    refined = torch.cat([fit.cars.refined for fit in fits])
    before, after = (
        float(torch.cat([getattr(fit, f"distance_{when}_m") for fit in fits])[refined].mean())
        for when in ("before", "after")
    )
    means = f", points {before:.3f} -> {after:.3f} m from the surface" if refined.any() else ""
    return f"{int(refined.sum())} of {len(refined)} cars fitted{means}"
