"""This script fits the probability that the front of a car is where a result from its mask has it, and judges it.

    D=$DIRECTSHAPE_DATA
    directshape calibrate-rig --data $D/kitti15 --from disparity --out rig15.json
    directshape refine --data $D/kitti15 --masks $D/kitti15/training/masks --rig rig15.json --out out/kitti15
    directshape refine --data $D/rendered --masks $D/rendered/training/masks --out out/rendered
    python scripts/calibrate_heading.py --run $D/kitti15 out/kitti15 --run $D/rendered out/rendered

Runs are started from masks; ROOT has their labels. Cars count if their label does, if they were refined, and if their
axis is within 25 degrees of the label's. The odds of the cheaper sense are `1 + d / scale` with the difference d of the
costs of both senses, which a probability of the run gives back. All roots have the same weight in the fit of the scale.
Each run is judged by the fit to the other roots, if there are any, and by the package.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from command_line import markdown_table, run_command
from numpy.typing import NDArray

from directshape_torch.errors import InputError
from directshape_torch.evaluation.matching import is_counted, match_to_labels
from directshape_torch.evaluation.pose_error import errors_of
from directshape_torch.io.kitti_labels import read_objects
from directshape_torch.io.result_files import read_shapes
from directshape_torch.refinement.candidates import SENSE_SCALE
from directshape_torch.status import Status

Array = NDArray[np.float64]
SCALES = np.geomspace(0.001, 2.0, 200)
BINS = (0.0, 0.9, 0.95, 1.0)
_SAME_AXIS_DEG, _NEAR_M = 25.0, 20.0


def probability(difference: Array, scale: float) -> Array:
    """Probability of the sense that costs less by `difference`, or more where it is negative."""
    of_dearer = 1 / (2 + np.abs(difference) / scale)
    return np.where(difference < 0, of_dearer, 1 - of_dearer)


def difference_of(probability: Array, scale: float) -> Array:
    """The difference of the costs that has a probability."""
    size = scale * (1 / np.minimum(probability, 1 - probability) - 2)
    return np.where(probability < 0.5, -size, size)


class Cars(NamedTuple):
    """The `Cars` are N counted cars of a run."""

    root: str
    run: str
    difference: Array  # (N,) costs of the opposite sense minus those of the result
    is_right: NDArray[np.bool_]  # (N,) the front is where the result has it
    distance_m: Array  # (N,)


def cars_of(root: Path, run: Path) -> Cars:
    """The cars of a run with labels.

    Raises:
        InputError: no car of the run counts.
    """
    rows = []
    for path in sorted((run / "shapes").glob("*.npz")):
        shapes, name = read_shapes(path), f"{path.stem}.txt"
        objects = read_objects(run / "data" / name)
        found = match_to_labels(objects, read_objects(root / "training" / "label_2" / name))
        for car, line in enumerate(shapes.input_lines.tolist()):
            label, chance = found.get(line - 1), float(shapes.probabilities_heading[car])
            if label is None or not is_counted(label) or not Status[shapes.statuses[car]].is_refined:
                continue
            (error,) = errors_of([objects[line - 1]], [label])
            if error.yaw_axis_deg < _SAME_AXIS_DEG and not np.isnan(chance):
                x, _, z = label.location_ref
                rows.append((chance, error.yaw_deg < 90, np.hypot(x, z)))
    if not rows:
        raise InputError("--run", "a run from masks with counted cars", str(run), "refine without --detections")
    chance, is_right, distance_m = np.array(rows, dtype=np.float64).T
    return Cars(root.name, run.name, difference_of(chance, SENSE_SCALE), is_right > 0, distance_m)


def fitted(runs: Sequence[Cars]) -> float:
    """The scale of least mean log loss, with the same weight for every root and for every run of a root."""
    roots = [run.root for run in runs]
    shares = [np.full(len(run.is_right), 1 / len(run.is_right) / roots.count(run.root)) for run in runs]
    difference, is_right, weight = (
        np.concatenate(x) for x in ([run.difference for run in runs], [run.is_right for run in runs], shares)
    )
    losses = [(weight * _log_loss(probability(difference, scale), is_right)).sum() for scale in SCALES]
    return float(SCALES[np.argmin(losses)])


def _log_loss(predicted: Array, is_right: NDArray[np.bool_]) -> Array:
    of_truth = np.where(is_right, predicted, 1 - predicted)
    return np.asarray(-np.log(of_truth.clip(1e-9)))


def reliability(runs: Sequence[Cars], scales: Sequence[float], title: str) -> str:
    """Table of the right share and of predicted and true shares in bins of the prediction, a row for each run."""
    heads = [f"{low:g} to {high:g}" for low, high in pairwise(BINS)]
    head = title, "cars", "right", f"below {_NEAR_M:g} m", "log loss", *heads
    lines = []
    for run, scale in zip(runs, scales, strict=True):
        predicted, near = probability(run.difference, scale), run.distance_m < _NEAR_M
        loss = _log_loss(predicted, run.is_right).mean()
        cells = [f"{run.root} {run.run}", f"{len(near)}", f"{run.is_right.mean():.2f}"]
        cells += [f"{run.is_right[near].mean():.2f} ({near.sum()})" if near.any() else "", f"{loss:.2f}"]
        for low, high in pairwise(BINS):
            within = (predicted >= low) & ((predicted < high) | (high == 1))
            shares = f"{predicted[within].mean():.2f}, {run.is_right[within].mean():.2f}" if within.any() else ""
            cells.append(f"{shares} ({within.sum()})")
        lines.append(cells)
    return markdown_table(head, lines)


def run(args: argparse.Namespace) -> None:
    """Fit, judge and print."""
    runs = [cars_of(Path(root), Path(folder)) for root, folder in args.run]
    print(f"scale: fit to all {fitted(runs):.3f}, package {SENSE_SCALE:.3f}\n")
    others = [[other for other in runs if other.root != each.root] for each in runs]
    if all(others):
        print(reliability(runs, [fitted(some) for some in others], "by the other roots"), end="\n\n")
    print(reliability(runs, [SENSE_SCALE] * len(runs), "by the package"))


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and run; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--run",
        nargs=2,
        action="append",
        required=True,
        metavar=("ROOT", "RUN"),
        help="folders of the data and of a run from its masks; may be repeated",
    )
    return run_command(parser, run, arguments)


if __name__ == "__main__":
    raise SystemExit(main())
