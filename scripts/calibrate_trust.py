"""Measures what refined boxes are off by and when a car is there, and judges both where they were not fitted.

    D=$DIRECTSHAPE_DATA; K=$D/kitti15; M=$K/training/masks
    python scripts/calibrate_trust.py --cars $K stereo $M --cars $K $K/detections/pointrcnn $M --cars .. --out out/trust

DETECTIONS are a folder of result files, or `stereo` or `mono`: a detector that is simulated from labels, ten times.
A run learns what its detector is off by from its own results, never from labels. Labels tell what the images are off by
and, beside boxes and masks that are laid on other images, when a car is there; each draw counts as much as another.
Each ROOT is judged by what the others have told; cars that the package refuses for want of evidence take no part.
Written to OUT: the draws, `report.md`, and `trust_model.json`, fitted to all.
"""

from __future__ import annotations

import argparse
import pickle
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import torch
from command_line import run_command
from trust_calibration.cars import Array, Cars, Judged, outcomes, probabilities, refined_cars, returned
from trust_calibration.draws import SIMULATED, write_draws
from trust_calibration.fit import fit_head, fit_noise

from directshape_torch.config import AcceptanceConfig
from directshape_torch.files.atomic_files import write_text
from directshape_torch.io.config_files import load_config
from directshape_torch.io.stereo_dataset import open_dataset
from directshape_torch.refinement.observability import CAR_QUANTITIES
from directshape_torch.refinement.trust import WORSE_BY, TrustModel, bundled_trust_model

BINS = (0.0, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 1.0)
_TO_SIGMA = 1 / 0.7407  # the median of |x| of Student's t of 4 degrees of freedom


def runs_of(args: argparse.Namespace) -> list[Cars]:
    """The refined cars of all runs, two at a time."""
    wanted = []
    for root, detections, masks in args.cars:
        if detections not in SIMULATED:
            wanted.append((Path(root), Path(detections), Path(masks), Path(detections).name, True))
            continue
        dataset = open_dataset("kitti", root, Path(root) / "training" / "label_2", masks)
        folders = [args.out / f"{Path(root).name}_{detections}_{seed}" for seed in range(args.draws)]
        write_draws(dataset, detections, folders)
        first = folders[0]
        wanted += [(Path(root), folder, Path(masks), detections, folder == first) for folder in folders]
    refine = partial(_refined, overrides=tuple(args.set), by_frame=args.by_frame)
    with ProcessPoolExecutor(args.workers, mp_context=get_context("spawn")) as pool:
        return [pickle.loads(content) for content in pool.map(refine, wanted)]


def _refined(run: tuple[Path, Path, Path, str, bool], overrides: Sequence[str], by_frame: bool) -> bytes:
    """The cars of a run, in one piece: tensors by themselves would each take an open file with them."""
    root, detections, masks, name, with_elsewhere = run
    found = refined_cars(root, detections, masks, name, overrides, with_elsewhere and not by_frame, by_frame)
    count = sum(len(frame.result) for frame in found.frames)
    print(f"{root.name} {detections.name}: {count} cars", file=sys.stderr, flush=True)
    return pickle.dumps(found)


def fitted(runs: Sequence[Cars]) -> TrustModel:
    """The model of some runs."""
    noise = fit_noise(runs)
    elsewhere = [run.judged(noise, elsewhere=True) for run in runs if run.elsewhere]
    head = fit_head([run.judged(noise) for run in runs], elsewhere) if elsewhere else bundled_trust_model().car_is_there
    provenance = {
        "made_by": "scripts/calibrate_trust.py",
        "cars": sum(len(frame.result) for run in runs for frame in run.frames),
        "runs": sorted({f"{run.root} {run.detector}" for run in runs}),
        "worse_by": WORSE_BY,
    }
    return TrustModel(head, noise, provenance)


def run(args: argparse.Namespace) -> None:
    """Refine, fit, judge, write."""
    args.out.mkdir(parents=True, exist_ok=True)
    runs = [run for run in runs_of(args) if run.frames]
    roots = list(dict.fromkeys(run.root for run in runs))
    others = roots[1:] and not args.by_frame
    models = {root: fitted([run for run in runs if run.root != root]) for root in roots} if others else {}
    of_all = bundled_trust_model() if args.by_frame else fitted(runs)
    of_all.save(args.out / "trust_model.json")
    judged = {id(run): run.judged(models.get(run.root, of_all).image_noise) for run in runs}
    own = "the package" if args.by_frame else "its own cars"
    how = f"Each root is judged by {'what the others have told' if models else own}."
    parts = [
        how,
        _policies(runs, judged, models, of_all, load_config(None, args.set).acceptance),
        _reliability(runs, judged, models, of_all),
        _coverage(runs, judged),
        _noises({"all": of_all, **{f"without {root}": model for root, model in models.items()}}),
    ]
    write_text(args.out / "report.md", "\n\n".join(parts) + "\n")
    print("\n\n".join(parts))


def _policies(
    runs: Sequence[Cars],
    judged: Mapping[int, Judged],
    models: Mapping[str, TrustModel],
    of_all: TrustModel,
    limits: AcceptanceConfig,
) -> str:
    """What comes back, a row for each detector on each root: means over the draws, with their standard deviation."""
    head = "cars", "runs, cars", "input", "images alone (worse)", "most probable (worse)", "returned (worse, share)"
    rows = ["| " + " | ".join((*head, "elsewhere")) + " |", "|" + "---|" * 7]
    for root, detector in dict.fromkeys((run.root, run.detector) for run in runs):
        some = [run for run in runs if (run.root, run.detector) == (root, detector)]
        model = models.get(root, of_all)
        cars = [judged[id(run)] for run in some]
        kept = [returned(each, model.car_is_there, limits) for each in cars]
        chosen = [np.where(k, c.after, c.before) for k, c in zip(kept, cars, strict=True)]
        inputs = _spread([float(c.before.mean()) for c in cars])
        cells = [_cell(cars, [c.images for c in cars]), _cell(cars, [c.after for c in cars]), _cell(cars, chosen)]
        cells[2] = f"{cells[2][:-1]}, {np.mean([k.mean() for k in kept]):.0%})"
        others = [run.judged(model.image_noise, elsewhere=True) for run in some if run.elsewhere]
        there = [returned(each, model.car_is_there, limits) for each in others]
        cells.append(f"{sum(k.sum() for k in there)} of {sum(len(k) for k in there)}" if there else "")
        counts = f"{len(some)}, {np.mean([len(c.before) for c in cars]):.0f}"
        rows.append(f"| {root} {detector} | {counts} | {inputs} | " + " | ".join(cells) + " |")
    return "\n".join(rows)


def _cell(cars: Sequence[Judged], after: Sequence[Array]) -> str:
    worse = np.mean([(a < c.before - WORSE_BY).mean() for a, c in zip(after, cars, strict=True)])
    return f"{_spread([float(a.mean()) for a in after])} ({100 * worse:.1f} %)"


def _spread(values: Sequence[float]) -> str:
    return f"{np.mean(values):.3f}" + (f" ± {np.std(values, ddof=1):.3f}" if values[1:] else "")


def _reliability(
    runs: Sequence[Cars], judged: Mapping[int, Judged], models: Mapping[str, TrustModel], of_all: TrustModel
) -> str:
    """Predicted beside true shares, in bins of the prediction."""
    pairs = [
        (probabilities(judged[id(run)], models.get(run.root, of_all).car_is_there), outcomes(judged[id(run)]))
        for run in runs
    ]
    predicted, true = (np.concatenate(x) for x in zip(*pairs, strict=True))
    rows = ["| predicted | better: predicted, true (cars) | not worse: predicted, true (cars) |", "|---|---|---|"]
    for low, high in pairwise(BINS):
        cells = []
        for column in range(2):
            within = (predicted[:, column] >= low) & ((predicted[:, column] < high) | (high == 1))
            figures = (
                f"{predicted[within, column].mean():.2f}, {true[within, column].mean():.2f}" if within.any() else ""
            )
            cells.append(f"{figures} ({within.sum()})")
        rows.append(f"| {low:g} to {high:g} | " + " | ".join(cells) + " |")
    return "\n".join(rows)


def _coverage(runs: Sequence[Cars], judged: Mapping[int, Judged]) -> str:
    """True errors over the standard deviations that are given, by their medians: 1 is right."""
    rows = ["| true over given sigma | " + " | ".join(CAR_QUANTITIES[:4]) + " |", "|---|---|---|---|---|"]
    for root in dict.fromkeys(run.root for run in runs):
        for detector in dict.fromkeys(run.detector for run in runs if run.root == root):
            some = [judged[id(run)].standard for run in runs if (run.root, run.detector) == (root, detector)]
            ratio = np.median(np.abs(np.concatenate(some)[:, :4]), axis=0) * _TO_SIGMA
            rows.append(f"| {root} {detector} | " + " | ".join(f"{x:.2f}" for x in ratio) + " |")
    return "\n".join(rows)


def _noises(models: Mapping[str, TrustModel]) -> str:
    rows = ["| images off by | " + " | ".join(CAR_QUANTITIES) + " | weights |", "|" + "---|" * 9]
    for name, model in {**models, "package": bundled_trust_model()}.items():
        values = [f"{factor:.2f}, {floor:.3f} m" for factor, floor in zip(*model.image_noise, strict=True)]
        weights = ", ".join(f"{weight:.2f}" for weight in (*model.car_is_there.weights, model.car_is_there.bias))
        rows.append(f"| {name} | " + " | ".join([*values, weights]) + " |")
    return "\n".join(rows)


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and run; returns the exit code."""
    torch.set_num_threads(1)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--cars",
        nargs=3,
        action="append",
        required=True,
        metavar=("ROOT", "DETECTIONS", "MASKS"),
        help="folders with labels of KITTI's object benchmark; may be repeated",
    )
    parser.add_argument("--draws", type=int, default=10, help="of each simulated detector")
    parser.add_argument(
        "--by-frame", action="store_true", help="each frame tells of rig and detector by itself; judge the package"
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    parser.add_argument("--set", nargs="+", default=["compile=off"], metavar="KEY=VALUE", help="other settings")
    return run_command(parser, run, arguments)


if __name__ == "__main__":
    raise SystemExit(main())
