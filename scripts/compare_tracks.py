"""This script compares cars in tracks with the same cars refined by themselves.

    for seed in 0 1 2 3 4 5 6 7; do
        python scripts/render_demo_scene.py --out out/sequences --sequence 0.3 --frames 8 --seed $seed \\
            --variant llvm_ad_rgb --paths-per-pixel 4
    done
    python scripts/compare_tracks.py --data out/sequences --detections out/sequences/detections/noisy_stereo \\
        --masks out/sequences/training/masks --out out/tracks

Every sequence is cut into pieces of as many frames as `--views` says, each refined in one call; the first number is the
one that the others are compared with. All numbers use the same cars: those that can be expected to be found
(`is_counted`), with the box that is returned, refined or not. With `--interval` cars move smoothly (docs/tracks.md).

The script prints tables in markdown: all cars, cars that turn relative to the camera by more than `--turn-deg` within
their sequence, and median errors of near and far faces by distance. It writes one line for each car, frame and number
of frames to `OUT/cars.csv`.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import groupby, pairwise
from pathlib import Path

import numpy as np
import torch
from command_line import run_command
from torch import Tensor

from directshape_torch.evaluation.matching import is_counted, match_to_labels
from directshape_torch.evaluation.pose_error import boxes_of, pose_errors
from directshape_torch.geometry.box3d import box_corners, pose_from_kitti
from directshape_torch.io.config_files import load_config
from directshape_torch.io.frame_collation import collate
from directshape_torch.io.stereo_dataset import LoadedFrame, open_dataset
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.rig.rig_file import load_rigs
from directshape_torch.rig.rigs import RigEstimates
from directshape_torch.shape.load_prior import load_prior

_WORSE = 0.05
_WITHIN_SIGMAS = 2.0
_DISTANCES_M = (0.0, 12.0, 20.0, 30.0, np.inf)

# Without --rig cameras are taken to be exact, and the results of the images are compared.
_AS_IT_IS = "rig.disparity_sigma_px=0", "priors.detector_weight=0"


@dataclass(frozen=True)
class CarOfFrame:
    """A `CarOfFrame` is a car in one frame, refined with `views` frames in a call.

    Attributes:
        track: track of the label.
        given_track: track of the detection.
        part: see `RefinementResult.track_part`.
        not_worse: probability to be not worse than the input, NaN if unknown.
        along_sigmas, yaw_sigmas: errors along the viewing ray and of the axis in standard deviations of the result; NaN
            without these.
    """

    sequence: str
    frame_id: str
    track: int
    views: int
    given_track: int
    part: int
    distance_m: float
    alpha: float
    refined: bool
    status: str
    not_worse: float
    iou_input: float
    iou: float
    length_m: float
    near_m: float
    far_m: float
    along_sigmas: float
    yaw_sigmas: float
    seconds: float

    @property
    def key(self) -> tuple[str, int]:
        return self.frame_id, self.track


def run(args: argparse.Namespace) -> None:
    """Refine, write and print."""
    torch.set_num_threads(args.threads)
    dataset = open_dataset(
        args.layout, args.data, args.detections, args.masks, tracks=True, split=args.split, frames=args.frames
    )
    refiner = DirectShapeRefiner(load_prior(args.prior), load_config(None, [*_AS_IT_IS, *args.set]))
    if args.rig is not None:
        rigs = load_rigs(args.rig)
        dataset = replace(dataset, disparity_fields=tuple(rig.field for rig in rigs))
        refiner.rig = RigEstimates(rigs)
    found: list[CarOfFrame] = []
    for _, ids in groupby(dataset.frame_ids, dataset.sequence_of):
        loaded = [dataset.load(frame_id) for frame_id in ids]
        loaded = [_timed(item, number, args.interval) for number, item in enumerate(loaded)]
        for views in args.views:
            for first in range(0, len(loaded), views):
                found += _refine(refiner, loaded[first : first + views], views)
        print(f"{loaded[-1].frame_id}: {len(found)} cars", flush=True)
    args.out.mkdir(parents=True, exist_ok=True)
    with (args.out / "cars.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, asdict(found[0]))
        writer.writeheader()
        writer.writerows(asdict(car) for car in found)
    print("\n".join(table(found, args.turn_deg)))


def _refine(refiner: DirectShapeRefiner, loaded: Sequence[LoadedFrame], views: int) -> Iterator[CarOfFrame]:
    frames, detections = collate(loaded)
    start = time.perf_counter()
    with torch.no_grad():
        result = refiner(frames, detections)
    seconds = (time.perf_counter() - start) / max(1, len(detections))
    boxes, first_row = result.to_boxes("kitti", "ref").double(), 0
    for item in loaded:
        yield from _cars(item, result, boxes, first_row, views, seconds)
        first_row += len(item.detections)


def _cars(
    item: LoadedFrame, result: RefinementResult, boxes: Tensor, first_row: int, views: int, seconds: float
) -> Iterator[CarOfFrame]:
    objects = item.detected_objects
    label_of = {k: label for k, label in match_to_labels(objects, item.labels or []).items() if is_counted(label)}
    rows, true = list(label_of), boxes_of(list(label_of.values()))
    boxes = boxes[[first_row + k for k in rows]]
    errors, before = pose_errors(boxes, true), pose_errors(boxes_of([objects[k] for k in rows]), true)
    reach, true_reach = _reach(boxes, true), _reach(true, true)
    status, sigma = result.status, result.sigma_xyz_yaw
    assert item.detections.track_id is not None
    given, part = item.detections.track_id.tolist(), result.track_part.tolist()
    for number, (k, label) in enumerate(label_of.items()):
        row = first_row + k
        near, far = (reach[number] - true_reach[number]).tolist()
        yield CarOfFrame(
            sequence=item.sequence or "",
            frame_id=item.frame_id,
            track=label.track_id,
            views=views,
            given_track=given[k],
            part=part[row],
            distance_m=label.location_ref[2],
            alpha=label.alpha,
            refined=status[row].is_refined,
            status=status[row].name,
            not_worse=float(result.quality.probability_not_worse[row]),
            iou_input=float(before.bev_iou[number]),
            iou=float(errors.bev_iou[number]),
            length_m=float(errors.length_m[number]),
            near_m=near,
            far_m=far,
            along_sigmas=float(errors.along_m[number].abs() / sigma[row, 0:3:2].norm()),
            yaw_sigmas=float(errors.yaw_axis_deg[number].deg2rad() / sigma[row, 3]),
            seconds=seconds,
        )


def _reach(
    boxes: Tensor,  # (N, 7)
    true: Tensor,  # (N, 7)
) -> Tensor:
    """Ranges (N, 2) of boxes along the viewing rays of the true ones, seen from above."""
    corners = box_corners(pose_from_kitti(boxes[:, :3], boxes[:, 6]), boxes[:, 3:6])[..., [0, 2]]
    rays = true[:, [0, 2]] / true[:, [0, 2]].norm(dim=1, keepdim=True)
    along = (corners * rays[:, None]).sum(dim=-1)
    return torch.stack([along.amin(dim=1), along.amax(dim=1)], dim=1)


def _timed(item: LoadedFrame, number: int, interval_s: float | None) -> LoadedFrame:
    """The frame with a time from the interval, or without a time, whatever its files say."""
    frame = item.frame
    time_s = None if interval_s is None else frame.images_left.new_tensor([number * interval_s])
    return replace(item, frame=replace(frame, time_s=time_s))


def table(found: Sequence[CarOfFrame], turn_deg: float) -> list[str]:
    """The lines of all tables."""
    lengths = list(dict.fromkeys(car.views for car in found))
    by_views = {views: {car.key: car for car in found if car.views == views} for views in lengths}
    keys = sorted(set.intersection(*(set(cars) for cars in by_views.values())))
    turning = _turning([by_views[lengths[0]][key] for key in keys], turn_deg)
    lines = []
    for what, chosen in (
        ("all cars", keys),
        (f"cars that turn by {turn_deg:g} degrees", [k for k in keys if k in turning]),
    ):
        lines += ["", f"{what} ({len(chosen)} views):", "", *_HEADING]
        for views in lengths if chosen else []:
            cars, alone = ([by_views[n][key] for key in chosen] for n in (views, lengths[0]))
            lines.append(_line(cars, alone))
    lines += ["", *(f"{views} frames: {_split(list(by_views[views].values()))}" for views in lengths[1:])]
    lines += ["", "| frames | " + " | ".join(f"near, far face, {name}" for name in _DISTANCE_NAMES) + " |"]
    lines.append("|---" * (1 + len(_DISTANCE_NAMES)) + "|")
    for views in lengths:
        lines.append(f"| {views} | " + " | ".join(_faces([by_views[views][key] for key in keys])) + " |")
    return lines


_HEADING = (
    "| frames | refined | BEV IoU, input | BEV IoU | worse than input, promised and found | worse, better than alone "
    "| length, rms and median | near face, rms | far face, rms | within 2 sigma: depth, axis | s a car and frame |",
    "|---|---|---|---|---|---|---|---|---|---|---|",
)
_DISTANCE_NAMES = ("0 to 12 m", "12 to 20 m", "20 to 30 m", "beyond")


def _split(cars: Sequence[CarOfFrame]) -> str:
    tracks: dict[tuple[str, int], list[int]] = {}
    for car in cars:
        tracks.setdefault((car.sequence, car.given_track), []).append(car.part)
    return f"{sum(max(parts) > 0 for parts in tracks.values())} of {len(tracks)} tracks split"


def _turning(cars: Sequence[CarOfFrame], turn_deg: float) -> set[tuple[str, int]]:
    """Keys of the cars whose observation angle changes by more than this within their sequence."""
    alphas: dict[tuple[str, int], list[float]] = {}
    for car in cars:
        alphas.setdefault((car.sequence, car.track), []).append(car.alpha)
    turned = {track: float(np.degrees(np.ptp(np.unwrap(angles)))) for track, angles in alphas.items()}
    return {car.key for car in cars if turned[car.sequence, car.track] > turn_deg}


def _line(cars: Sequence[CarOfFrame], alone: Sequence[CarOfFrame]) -> str:
    iou, iou_alone = (np.array([car.iou for car in some]) for some in (cars, alone))
    iou_input = np.array([car.iou_input for car in cars])
    shares = [f"{np.mean(iou < other - _WORSE):.1%}" for other in (iou_input, iou_alone)]
    trusted = [car.not_worse for car in cars if car.refined]
    shares[0] = f"{np.sum(1 - np.array(trusted)) / len(cars):.1%}, {shares[0]}"
    shares[1] += f", {np.mean(iou > iou_alone + _WORSE):.1%}"
    rms = [f"{_rms([getattr(car, name) for car in cars]):.3f} m" for name in ("length_m", "near_m", "far_m")]
    rms[0] += f", {np.median([abs(car.length_m) for car in cars]):.3f} m"
    sigmas = np.array([(car.along_sigmas, car.yaw_sigmas) for car in cars if car.refined])
    seconds = np.mean([car.seconds for car in cars])
    refined = f"{np.mean([car.refined for car in cars]):.1%}"
    cells = [
        str(cars[0].views),
        refined,
        f"{iou_input.mean():.3f}",
        f"{iou.mean():.3f}",
        *shares,
        *rms,
        ", ".join(f"{share:.0%}" for share in (sigmas < _WITHIN_SIGMAS).mean(axis=0)),
        f"{seconds:.2f}",
    ]
    return "| " + " | ".join(cells) + " |"


def _faces(cars: Sequence[CarOfFrame]) -> Iterator[str]:
    """Medians of the absolute errors, by distance."""
    for low, high in pairwise(_DISTANCES_M):
        near = [abs(car.near_m) for car in cars if low <= car.distance_m < high]
        far = [abs(car.far_m) for car in cars if low <= car.distance_m < high]
        yield f"{100 * np.median(near):.1f}, {100 * np.median(far):.1f} cm ({len(near)})" if near else "-"


def _rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and run; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, metavar="ROOT", help="folder of the data set, with labels")
    parser.add_argument("--layout", choices=("tracking", "raw", "folder"), default="tracking")
    parser.add_argument("--detections", type=Path, metavar="DIR")
    parser.add_argument("--masks", type=Path, metavar="DIR")
    parser.add_argument("--split", type=Path, metavar="FILE", help="one frame id a line")
    parser.add_argument("--frames", nargs="+", metavar="ID")
    parser.add_argument("--views", type=int, nargs="+", default=[1, 2, 4, 8], help="frames in a call (default 1 2 4 8)")
    parser.add_argument("--turn-deg", type=float, default=20.0, help="(default 20)")
    parser.add_argument("--interval", type=float, metavar="SECONDS", help="between frames; default: not known")
    parser.add_argument("--rig", type=Path, metavar="FILE", help="of 'calibrate-rig' or a run; default: none")
    parser.add_argument("--prior", default="pca", metavar="FILE|NAME", help="shapes (default: %(default)s)")
    parser.add_argument("--set", nargs="+", default=[], metavar="KEY=VALUE", help="settings, as of 'refine'")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    return run_command(parser, run, arguments)


if __name__ == "__main__":
    raise SystemExit(main())
