"""Would each car's own ground height, measured round its foot, be better than the frame's ground plane?

The height prior of the refinement holds every car to the plane of its frame. Kerbs, crowned roads and the opposite
carriageway are not on it. This measures, for each labelled car that a detection was found for,

  truth   height of the label's bottom centre above the frame's plane
  local   height above that plane of the stereo points in a ring round the DETECTION's footprint, outside of all masks:
          median of the points within 0.6 m of the plane

and prints how far the truth is from 0 (the plane alone), from `local`, and from `local` drawn towards 0 by what its own
scatter is worth; RMS, and MAD, which forgives a constant (labels that stand 4 cm above the road); the correlation. The
plane is the one that the refinement would use: files, or with a field the corrected stereo pair. A measured height is
worth building in only where the figures under `local` are clearly below those under `plane`.

    python scripts/judge_local_ground.py --data ROOT --detections DIR --masks DIR [--stereo-bias bias.json] [--refine]

With --refine every frame is refined with its plane, and once for each car with the plane moved to the car's local
(drawn towards 0) and to its true height, of which that car's box is kept: the last row is what perfect heights are
worth.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from command_line import run_command
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from directshape_torch.evaluation.rotated_iou import bev_boxes, bev_iou, iou_3d
from directshape_torch.files.atomic_files import write_text
from directshape_torch.geometry.box3d import box_corners
from directshape_torch.geometry.camera import points_from_disparity
from directshape_torch.geometry.ground_plane import height_above
from directshape_torch.geometry.se3 import inverse, transform
from directshape_torch.io.kitti_dataset import KittiStereoDataset
from directshape_torch.io.kitti_labels import KittiObject, poses_cam
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.result import KittiBoxes
from directshape_torch.rig.rig_file import load_fields
from directshape_torch.stereo_matching.disparity import match_disparity

CLASSES = ("Car", "Van")
SMALLEST_HEIGHT_PX = 25.0
LARGEST_OCCLUSION = 1
LARGEST_DISTANCE_M = 4.0
RING_M = (0.25, 1.25)
LARGEST_OFFSET_M = 0.6
FEWEST_POINTS = 40
MASK_MARGIN_PX = 3
# Neighbouring pixels of semi-global matching err alike: so many of them count as one.
PIXELS_PER_INDEPENDENT = 25
# Spread of true heights over the plane that is expected beforehand: local heights less certain are not believed.
PRIOR_SIGMA_M = 0.05


@dataclass(frozen=True)
class JudgedCar:
    """Heights above the frame's plane, metres."""

    frame_id: str
    detection: int
    label_line: int
    depth_m: float
    lateral_m: float
    truth_m: float
    local_m: float
    sigma_m: float
    num_points: int

    @property
    def shrunk_m(self) -> float:
        """The local height drawn towards the plane by its own uncertainty."""
        return self.local_m * PRIOR_SIGMA_M**2 / (PRIOR_SIGMA_M**2 + self.sigma_m**2)


def judge_frame(loaded: LoadedFrame, labels: Sequence[KittiObject]) -> list[JudgedCar]:
    """Every counted label of a frame that a detection stands near and round whose foot there are points."""
    frame = loaded.frame
    normal, offset = frame.ground.normal[0].double(), frame.ground.offset[0].double()
    points_cam = _free_points(loaded)
    heights = height_above(points_cam, normal, offset)
    near_plane = heights.abs() < LARGEST_OFFSET_M
    points_cam, heights = points_cam[near_plane], heights[near_plane]
    T_cam_obj = loaded.detections.T_cam_obj.double()
    judged = []
    for label in labels:
        position = poses_cam([label], frame.camera.t_cam_ref[0].double())[0, :3, 3]
        distance = (T_cam_obj[:, :3, 3] - position).norm(dim=1)
        if len(distance) == 0 or float(distance.min()) > LARGEST_DISTANCE_M:
            continue
        nearest = int(distance.argmin())
        inside = _in_ring(points_cam, T_cam_obj[nearest], loaded.detections.dimensions_hwl[nearest].double())
        found = heights[inside]
        if len(found) < FEWEST_POINTS:
            continue
        local = found.median()
        spread = 1.4826 * float((found - local).abs().median())
        sigma = 1.2533 * spread / max(len(found) / PIXELS_PER_INDEPENDENT, 1.0) ** 0.5
        truth = float(height_above(position, normal, offset))
        depth, lateral = float(position[2]), float(position[0])
        judged.append(
            JudgedCar(
                frame.frame_ids[0], nearest, label.line_number, depth, lateral, truth, float(local), sigma, len(found)
            )
        )
    return judged


def counted_labels(loaded: LoadedFrame) -> list[KittiObject]:
    """Labels at least 25 px high and occluded at most 1."""
    return [
        o
        for o in loaded.labels or ()
        if o.type in CLASSES
        and o.box_2d[3] - o.box_2d[1] >= SMALLEST_HEIGHT_PX
        and o.occluded <= LARGEST_OCCLUSION
        and o.truncated <= 0.5
    ]


def _free_points(loaded: LoadedFrame) -> Tensor:
    """Stereo points (P, 3) of the left pixels outside of all masks, freed of the rig's field."""
    import cv2

    frame = loaded.frame
    left, right = (
        (image[0].permute(1, 2, 0) * 255).round().to(torch.uint8).numpy()
        for image in (frame.images_left, frame.images_right)
    )
    disparity = torch.from_numpy(match_disparity(left, right)).double()
    masks = [loaded.detections.mask_left > 0.5]
    if loaded.detections.occluders is not None:
        masks.append(loaded.detections.occluders.mask_left > 0.5)
    covered: NDArray[np.uint8] = torch.cat(masks).any(dim=0).numpy().astype(np.uint8)
    grown = cv2.dilate(covered, np.ones((2 * MASK_MARGIN_PX + 1,) * 2, np.uint8))
    v, u = torch.nonzero(disparity.isfinite() & torch.from_numpy(grown == 0), as_tuple=True)
    camera = frame.camera.to(dtype=torch.float64)
    points_cam = points_from_disparity(
        torch.stack([u, v], dim=-1).double(),
        disparity[v, u],
        camera.K_left[0],
        camera.K_right[0],
        camera.T_right_cam[0],
        camera.disparity_field,
    )
    return points_cam[points_cam.isfinite().all(dim=1)]


def _in_ring(points_cam: Tensor, T_cam_obj: Tensor, dimensions_hwl: Tensor) -> Tensor:
    """Which points (P,) lie round the box's footprint, seen from above."""
    points_obj = transform(inverse(T_cam_obj), points_cam)
    corners_obj = box_corners(torch.eye(4, dtype=torch.float64), dimensions_hwl)
    half = corners_obj.abs().amax(dim=0)
    beyond = (points_obj[:, [0, 2]].abs() - half[[0, 2]]).clamp_min(0).norm(dim=1)
    return (beyond > RING_M[0]) & (beyond < RING_M[1])


def refined_overlaps(
    loaded: LoadedFrame, cars: Sequence[JudgedCar], refiner: DirectShapeRefiner
) -> list[tuple[float, ...]]:
    """BEV and 3D IoU with the label of each car: refined on the plane, at its local and at its true height."""
    labels = {o.line_number: o for o in loaded.labels or ()}
    common = refiner(loaded.frame, loaded.detections).boxes()
    overlaps = []
    for car in cars:
        truth = _box(labels[car.label_line])
        row = list(_overlap(common, car.detection, truth))
        for height_m in (car.shrunk_m, car.truth_m):
            ground = replace(loaded.frame.ground, offset=loaded.frame.ground.offset - height_m)
            boxes = refiner(replace(loaded.frame, ground=ground), loaded.detections).boxes()
            row += _overlap(boxes, car.detection, truth)
        overlaps.append(tuple(row))
    return overlaps


def _box(label: KittiObject) -> Tensor:
    return torch.tensor([[*label.location_ref, *label.hwl, label.rotation_y]], dtype=torch.float64)


def _overlap(boxes: KittiBoxes, index: int, truth: Tensor) -> tuple[float, float]:
    parts = (boxes.location_ref[index], boxes.dimensions_hwl[index], boxes.rotation_y[index : index + 1])
    box = torch.cat(parts)[None].double()
    return float(bev_iou(bev_boxes(box), bev_boxes(truth))[0]), float(iou_3d(box, truth)[0])


def overlap_report(overlaps: Sequence[tuple[float, ...]]) -> str:
    """Means over the cars."""
    means = np.array(overlaps).mean(axis=0)
    lines = [f"refined, {len(overlaps)} cars             mean BEV IoU   mean 3D IoU"]
    for k, name in enumerate(("plane", "local height, shrunk", "true height")):
        lines.append(f"  {name:<28}{means[2 * k]:10.3f}    {means[2 * k + 1]:10.3f}")
    return "\n".join(lines) + "\n"


def _line(name: str, cars: Sequence[JudgedCar]) -> str:
    truth, local, shrunk = (np.array([getattr(c, key) for c in cars]) for key in ("truth_m", "local_m", "shrunk_m"))
    errors = (truth, truth - local, truth - shrunk)
    root_mean_squares = [np.sqrt((e**2).mean()) for e in errors]
    deviations = [np.median(np.abs(e - np.median(e))) for e in errors]
    correlation = np.corrcoef(truth, local)[0, 1] if len(cars) > 2 else np.nan
    numbers = "  ".join(
        f"{100 * value:6.1f}" for value in (truth.mean(), local.mean(), *root_mean_squares, *deviations)
    )
    return f"{name:<22}{len(cars):4d}  {numbers}  {correlation:+6.2f}"


def report(cars: Sequence[JudgedCar]) -> str:
    """The table, centimetres."""
    groups: list[tuple[str, Iterable[JudgedCar]]] = [
        ("all", cars),
        ("up to 20 m", [c for c in cars if c.depth_m < 20]),
        ("20 m and more", [c for c in cars if c.depth_m >= 20]),
        ("|x| under 6 m", [c for c in cars if abs(c.lateral_m) < 6]),
        ("|x| 6 m and more", [c for c in cars if abs(c.lateral_m) >= 6]),
        ("truth beyond 10 cm", [c for c in cars if abs(c.truth_m) > 0.1]),
        ("sigma under 1 cm", [c for c in cars if c.sigma_m < 0.01]),
    ]
    header = "centimetres                  mean of       RMS of truth minus       MAD of truth minus   correlation"
    names = "                         n   truth   local   plane   local  shrunk   plane   local  shrunk"
    return "\n".join([header, names, *(_line(name, list(group)) for name, group in groups if list(group))]) + "\n"


def csv_text(cars: Sequence[JudgedCar]) -> str:
    """One line for each car."""
    names = list(JudgedCar.__dataclass_fields__)
    return "\n".join([",".join(names), *(",".join(str(getattr(c, n)) for n in names) for c in cars)]) + "\n"


def run(args: argparse.Namespace) -> int:
    """Measure and print; 1 where no car could be measured."""
    field = None if args.stereo_bias is None else load_fields(args.stereo_bias)
    dataset = KittiStereoDataset(args.data, args.detections, args.masks, frames=args.frames, disparity_field=field)
    cars: list[JudgedCar] = []
    overlaps: list[tuple[float, ...]] = []
    refiner = DirectShapeRefiner() if args.refine else None
    num_labels = 0
    for frame_id in tqdm(dataset.frame_ids, desc="frames", unit="frame", disable=not sys.stderr.isatty()):
        loaded = dataset.load(frame_id)
        labels = counted_labels(loaded)
        num_labels += len(labels)
        judged = judge_frame(loaded, labels)
        cars += judged
        if refiner is not None and judged:
            overlaps += refined_overlaps(loaded, judged, refiner)
    if not cars:
        print("no car could be measured", file=sys.stderr)
        return 1
    print(f"{len(cars)} of {num_labels} counted labels in {len(dataset)} frames have a detection and points near by")
    print(report(cars), end="")
    if overlaps:
        print(overlap_report(overlaps), end="")
    if args.csv is not None:
        write_text(args.csv, csv_text(cars))
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and run; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, metavar="ROOT", help="folder that holds training/")
    parser.add_argument("--detections", type=Path, required=True, metavar="DIR", help="NNNNNN.txt in DIR or DIR/data")
    parser.add_argument("--masks", type=Path, required=True, metavar="DIR", help="instance masks, as for refine")
    parser.add_argument("--stereo-bias", type=Path, metavar="FILE", help="field of 'directshape calibrate-rig'")
    parser.add_argument("--frames", nargs="+", metavar="ID", help="default all that have detections")
    parser.add_argument("--refine", action="store_true", help="refine at each height too (minutes)")
    parser.add_argument("--csv", type=Path, metavar="FILE", help="write one line for each car")
    return run_command(parser, run, arguments)


if __name__ == "__main__":
    raise SystemExit(main())
