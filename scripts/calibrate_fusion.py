"""Measures what the images are off by, and whether bringing them together with the detector's boxes does any harm.

    D=$DIRECTSHAPE_DATA
    python scripts/calibrate_fusion.py --cars $D/kitti15 $D/kitti15/detections/noisy_stereo $D/kitti15/training/masks
        --cars $D/kitti15 $D/kitti15/detections/pointrcnn $D/kitti15/training/masks
        --cars $D/kitti $D/kitti/detections/noisy_stereo $D/kitti/training/masks ..

Every result is returned. A run learns what its detector is off by from its own results, never from labels; labels tell
factors and floors of the images' standard deviations (Student's t of 4 degrees of freedom) and judge. "Left out" judges
the cars of a ROOT by what the cars of all other ROOTs have told, "package" by what the package has. "Better" compares
the share of the latter that overlap their label more than the input with the mean of `probability_better`, which speaks
of the images' boxes. "Elsewhere" lays boxes and masks on the images of the frame seven further on, where there is no
such car: the share that comes back refined. The last table has the run's estimate of its detector over its true errors,
the median over all sets.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from command_line import run_command
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.config import AcceptanceConfig
from directshape_torch.evaluation.matching import is_counted, match_to_labels
from directshape_torch.evaluation.pose_error import boxes_of, pose_errors
from directshape_torch.geometry.box3d import pose_from_kitti
from directshape_torch.io.config_files import load_config
from directshape_torch.io.stereo_dataset import open_dataset
from directshape_torch.refinement.fusion import IMAGE_NOISE, ImageNoise, fused
from directshape_torch.refinement.observability import CAR_QUANTITIES
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.rig.detector_noise import detector_sigmas, rows_of
from directshape_torch.rig.from_files import estimate_rigs
from directshape_torch.rig.rigs import RigEstimates
from directshape_torch.scene import Detections

WORSE_BY = 0.05
UNCALIBRATED = ImageNoise((1.0,) * 7, (0.0,) * 7)
FACTORS, FLOORS = np.r_[0.0, np.geomspace(0.1, 4, 25)], np.geomspace(0.005, 0.5, 40)
_TO_SIGMA = 1.4826
_FRAMES_ON = 7


class Frame(NamedTuple):
    """The counted cars of a frame that were refined, by the images alone."""

    result: RefinementResult
    detections: Detections
    truth: Detections  # with the labels' boxes
    boxes: tuple[Tensor, Tensor]  # (N, 7) of the detections and the labels in the frame of labels


@dataclass(frozen=True)
class Cars:
    """The refined cars of one data set from the boxes of one detector."""

    root: Path
    name: str
    frames: list[Frame]
    elsewhere: float  # share of cars that are refined where there are none

    def comparisons(self, noise: ImageNoise, with_truth: bool = False) -> Tensor:
        """Rows (N, 15) of `rig.detector_noise`, of the detector or of the labels."""
        boxes = [frame.truth if with_truth else frame.detections for frame in self.frames]
        pairs = zip(self.frames, boxes, strict=True)
        return torch.cat([rows_of(fused(frame.result, each, None, noise).comparison) for frame, each in pairs])

    def overlaps(self, noise: ImageNoise | None) -> tuple[NDArray[Any], NDArray[Any]]:
        """Overlaps of the input and of the fused boxes with the labels; without a noise the images' boxes stay."""
        sigmas = None if noise is None else detector_sigmas(self.comparisons(noise))
        before, after = [], []
        for frame in self.frames:
            together = fused(frame.result, frame.detections, sigmas, noise or IMAGE_NOISE)
            detector, truth = frame.boxes
            before.append(pose_errors(detector, truth).bev_iou)
            after.append(pose_errors(together.to_boxes("kitti", "ref").double(), truth).bev_iou)
        return torch.cat(before).numpy(), torch.cat(after).numpy()


def refined_cars(root: Path, detections: Path, masks: Path, overrides: Sequence[str]) -> Cars:
    """All counted cars of a data set, refined with the rig that their run estimates."""
    dataset = open_dataset("kitti", root, detections, masks)
    name = f"{root.name} {detections.name}"
    rigs = RigEstimates(estimate_rigs(dataset))
    everything = AcceptanceConfig(min_probability_better=0.0, min_probability_not_worse=0.0)
    config = replace(load_config(None, overrides), acceptance=everything, check="off")
    refiner, frames = DirectShapeRefiner(config=config, rig=rigs), []
    all_frames = [dataset.load(frame_id) for frame_id in dataset.frame_ids]
    nowhere: list[bool] = []
    for number, loaded in enumerate(all_frames):
        other = all_frames[(number + _FRAMES_ON) % len(all_frames)].frame
        if other.images_left.shape == loaded.frame.images_left.shape and other is not loaded.frame:
            seen = loaded.detections.has_mask_left
            nowhere += refiner(other, loaded.detections).refined[seen].tolist()
        result = refiner(loaded.frame, loaded.detections)
        found = match_to_labels(loaded.detected_objects, loaded.labels or [])
        rows = [row for row, label in found.items() if result.refined[row] and is_counted(label)]
        if not rows:
            continue
        index, truth = torch.tensor(rows), boxes_of([found[row] for row in rows])
        chosen = loaded.detections.rows(index)
        T_truth = pose_from_kitti(truth[:, :3], truth[:, 6]).to(chosen.T_cam_obj)
        T_truth[:, :3, 3] += result.t_cam_ref[index]
        labels = replace(chosen, T_cam_obj=T_truth, dimensions_hwl=truth[:, 3:6].to(chosen.dimensions_hwl))
        before = boxes_of([loaded.detected_objects[row] for row in rows])
        frames.append(Frame(result[index], chosen, labels, (before, truth)))
    print(f"{name}: {sum(len(frame.result) for frame in frames)} cars", file=sys.stderr, flush=True)
    return Cars(root, name, frames, float(np.mean(nowhere)) if nowhere else np.nan)


def fitted(sets: Iterable[Cars]) -> ImageNoise:
    """Factors and floors of the highest likelihood."""
    rows = torch.cat([cars.comparisons(UNCALIBRATED, with_truth=True) for cars in sets]).numpy()
    pairs = [_most_likely(rows[:, 1 + k], rows[:, 8 + k]) for k in range(7)]
    factors, floors = zip(*pairs, strict=True)
    return ImageNoise(factors, floors)


def _most_likely(error: NDArray[Any], sigma: NDArray[Any]) -> tuple[float, float]:
    factor, floor = (x.reshape(-1, 1) for x in np.meshgrid(FACTORS, FLOORS))
    variance = (factor * sigma) ** 2 + floor**2
    cost = (0.5 * np.log(variance) + 2.5 * np.log1p(error**2 / variance / 4)).sum(axis=1)
    best = int(cost.argmin())
    return float(factor[best, 0]), float(floor[best, 0])


def shown(cars: Cars, noise: ImageNoise) -> NDArray[Any]:
    """What the run's estimate has of the detector's errors against labels, (7,)."""
    of_detector, of_labels = (cars.comparisons(noise, with_truth) for with_truth in (False, True))
    errors = (of_detector[:, 1:8] - of_labels[:, 1:8]).abs()
    errors[:, 0] /= of_detector[:, 0]
    estimate: NDArray[Any] = detector_sigmas(of_detector).numpy()
    return estimate / (_TO_SIGMA * errors.median(dim=0).values.numpy())


def run(args: argparse.Namespace) -> None:
    """Refine, fit, judge, print."""
    sets = [refined_cars(*map(Path, each), args.set) for each in args.cars]
    roots = list(dict.fromkeys(cars.root for cars in sets))
    left_out = {root: fitted(cars for cars in sets if cars.root != root) for root in roots} if roots[1:] else {}
    print("| cars | n | input | images alone (worse) | left out | package | better: came true, predicted | elsewhere |")
    print("|---|---|---|---|---|---|---|---|")
    for cars in sets:
        cells = [_cell(*cars.overlaps(noise)) for noise in (None, left_out.get(cars.root), IMAGE_NOISE)]
        cells[1] = cells[1] if cars.root in left_out else ""
        before, after = cars.overlaps(IMAGE_NOISE)
        predicted = torch.cat([frame.result.quality.probability_better for frame in cars.frames]).nanmean()
        cells += [f"{(after > before).mean():.2f}, {float(predicted):.2f}", f"{100 * cars.elsewhere:.0f} %"]
        print(f"| {cars.name} | {len(before)} | {before.mean():.3f} | {' | '.join(cells)} |")
    print("\n| images off by | " + " | ".join(CAR_QUANTITIES) + " |\n|" + "---|" * 8)
    of_all = {"all": fitted(sets), **{f"without {root.name}": noise for root, noise in left_out.items()}}
    for name, noise in {**of_all, "package": IMAGE_NOISE}.items():
        values = (f"{factor:.2f}, {floor:.3f} m" for factor, floor in zip(*noise, strict=True))
        print(f"| {name} | " + " | ".join(values) + " |")
    middle = np.median([shown(cars, IMAGE_NOISE) for cars in sets], axis=0)
    print("| estimate over truth of the detector | " + " | ".join(f"{value:.2f}" for value in middle) + " |")


def _cell(before: NDArray[Any], after: NDArray[Any]) -> str:
    return f"{after.mean():.3f} ({(after < before - WORSE_BY).mean():.1%})".replace("%", " %")


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and run; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--cars",
        nargs=3,
        action="append",
        required=True,
        metavar=("ROOT", "DETECTIONS", "MASKS"),
        help="folders with labels of KITTI's object benchmark; may be repeated",
    )
    parser.add_argument("--set", nargs="+", default=[], metavar="KEY=VALUE", help="other settings than the default")
    return run_command(parser, run, arguments)


if __name__ == "__main__":
    raise SystemExit(main())
