"""This script fits the trust model: the errors of refined boxes and the probability that a car is there.

    D=$DIRECTSHAPE_DATA; K=$D/kitti15; M=$K/training/masks
    python scripts/calibrate_trust.py --cars $K stereo $M --cars $K $K/detections/pointrcnn $M --cars .. --out out/trust

DETECTIONS are a folder of result files, or `stereo` or `mono` for a detector that is simulated from labels, ten times.
A run learns the errors of its detector from its own results, never from labels. Labels give the errors of the images,
and, together with boxes and masks on unrelated images, when a car is there; all draws have the same weight. If all runs
have other roots (by the names of their folders) with other detectors, each run is judged by a model that was fitted to
these. Cars that the package refuses for lack of evidence are excluded.

The draws, `report.md` and `trust_model.json`, fitted to all runs, are written to OUT.
"""

from __future__ import annotations

import argparse
import pickle
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np
import torch
from command_line import markdown_table, run_command
from numpy.typing import NDArray
from trust_calibration.cars import Array, Cars, Judged, outcomes, probabilities, refined_cars, returned
from trust_calibration.draws import SIMULATED, write_draws
from trust_calibration.fit import evidence_of, fit_head, fit_noise

from directshape_torch.config import AcceptanceConfig
from directshape_torch.files.atomic_files import write_text
from directshape_torch.io.config_files import load_config
from directshape_torch.io.stereo_dataset import open_dataset
from directshape_torch.refinement.observability import CAR_QUANTITIES
from directshape_torch.refinement.trust import WORSE_BY, TrustModel, bundled_trust_model

THRESHOLDS = (0.0, 0.7, 0.8, 0.85, 0.9, 0.95)
BINS = (0.0, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 1.0)
_TO_SIGMA = 1 / 0.7407  # the median of |x| of Student's t of 4 degrees of freedom


def runs_of(args: argparse.Namespace) -> list[Cars]:
    """The refined cars of all runs, two runs at a time."""
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
    """Pickled cars of a run; as single tensors each would need an open file to cross processes."""
    root, detections, masks, name, is_first = run
    found = refined_cars(root, detections, masks, name, overrides, is_first and not by_frame, by_frame)
    count = sum(len(frame.result) for frame in found.frames)
    print(f"{root.name} {detections.name}: {count} cars", file=sys.stderr, flush=True)
    return pickle.dumps(found)


def fitted(runs: Sequence[Cars]) -> TrustModel:
    """The model that fits the given runs."""
    noise = fit_noise(runs)
    there, not_there = evidence_of(runs, noise)
    head = fit_head(there, not_there) if len(not_there) else bundled_trust_model().car_is_there
    provenance = {
        "made_by": "scripts/calibrate_trust.py",
        "cars": sum(len(frame.result) for run in runs for frame in run.frames),
        "runs": sorted({f"{run.root} {run.detector}" for run in runs}),
        "worse_by": WORSE_BY,
    }
    return TrustModel(head, noise, provenance)


def run(args: argparse.Namespace) -> None:
    """Refine, fit, judge and write."""
    args.out.mkdir(parents=True, exist_ok=True)
    runs = [run for run in runs_of(args) if run.frames]
    rows = list(dict.fromkeys((run.root, run.detector) for run in runs))
    others = {row: others_of(runs, row) for row in rows}
    left_out = not args.by_frame and all(others.values())
    of_all = bundled_trust_model() if args.by_frame else fitted(runs)
    models = {row: fitted(others[row]) if left_out else of_all for row in rows}
    of_all.save(args.out / "trust_model.json")
    judged = {row: _judged(runs, row, models[row]) for row in rows}
    own = "the package" if args.by_frame else "its own cars"
    how = f"Each row is judged by {'what other roots with other detectors have told' if left_out else own}."
    limits = load_config(None, args.set).acceptance
    parts = [
        how,
        _policies(judged, limits),
        _thresholds(judged, limits),
        _reliability(judged),
        _coverage(judged),
        *([_by_one_root(runs, judged, limits)] if left_out else []),
        _noises({"all": of_all, **({"without " + " ".join(row): models[row] for row in rows} if left_out else {})}),
    ]
    write_text(args.out / "report.md", "\n\n".join(parts) + "\n")
    print("\n\n".join(parts))


def others_of(runs: Sequence[Cars], row: tuple[str, str]) -> list[Cars]:
    """The runs of other roots with other detectors than those of a row."""
    return [run for run in runs if run.root != row[0] and run.detector != row[1]]


class JudgedRow(NamedTuple):
    """A `JudgedRow` has the runs of one detector on one root, one for each draw, judged by a model."""

    cars: list[Judged]
    elsewhere: list[Judged]
    model: TrustModel

    def returned(self, cars: list[Judged], limits: AcceptanceConfig) -> list[NDArray[np.bool_]]:
        """Whether the boxes of some runs of the row are returned, run by run."""
        return [returned(each, self.model.car_is_there, limits) for each in cars]

    def chosen(self, cars: list[Judged], limits: AcceptanceConfig) -> list[Array]:
        """IoU of the boxes that are returned, run by run."""
        pairs = zip(self.returned(cars, limits), cars, strict=True)
        return [np.where(kept, each.after, each.before) for kept, each in pairs]


Rows: TypeAlias = Mapping[tuple[str, str], JudgedRow]
"""The keys are root and detector."""


def _judged(runs: Sequence[Cars], row: tuple[str, str], model: TrustModel) -> JudgedRow:
    some, noise = [run for run in runs if (run.root, run.detector) == row], model.image_noise
    elsewhere = [run.judged(noise, run.elsewhere) for run in some if run.elsewhere]
    return JudgedRow([run.judged(noise, run.frames) for run in some], elsewhere, model)


def _policies(rows: Rows, limits: AcceptanceConfig) -> str:
    """Table of returned boxes, a row for each detector and root: means over draws with standard deviations."""
    head = "cars", "runs, cars", "input", "images alone (worse)", "most probable (worse)", "returned (worse, share)"
    lines = []
    for (root, detector), row in rows.items():
        cars, share = row.cars, np.mean([kept.mean() for kept in row.returned(row.cars, limits)])
        inputs = _spread([float(each.before.mean()) for each in cars])
        cells = [_cell(cars, [each.images for each in cars]), _cell(cars, [each.after for each in cars])]
        cells.append(f"{_cell(cars, row.chosen(row.cars, limits))[:-1]}, {share:.0%})")
        there = row.returned(row.elsewhere, limits)
        cells.append(f"{sum(each.sum() for each in there)} of {sum(map(len, there))}" if there else "")
        counts = f"{len(cars)}, {np.mean([len(each.before) for each in cars]):.0f}"
        lines.append([f"{root} {detector}", counts, inputs, *cells])
    return markdown_table((*head, "returned on other images"), lines)


def _by_one_root(runs: Sequence[Cars], rows: Rows, limits: AcceptanceConfig) -> str:
    """Table of returned boxes where a row is judged by the other detectors of one other root alone."""
    roots = list(dict.fromkeys(root for root, _ in rows))
    lines = []
    for row in rows:
        cells = []
        for root in roots:
            some = [run for run in others_of(runs, row) if run.root == root]
            cells.append(_returned(_judged(runs, row, fitted(some)), limits) if some else "")
        lines.append([" ".join(row), *cells])
    return markdown_table(("returned, judged by one root", *roots), lines)


def _returned(row: JudgedRow, limits: AcceptanceConfig) -> str:
    return _cell(row.cars, row.chosen(row.cars, limits), with_spread=False)


def _thresholds(rows: Rows, limits: AcceptanceConfig) -> str:
    """Table of returned boxes for other limits of the probability of a box that is not worse."""
    head = f"better from {limits.min_probability_better:g}, not worse from", *(f"{least:g}" for least in THRESHOLDS)
    others = [replace(limits, min_probability_not_worse=least) for least in THRESHOLDS]
    return markdown_table(
        head, [[" ".join(of), *(_returned(row, other) for other in others)] for of, row in rows.items()]
    )


def _cell(cars: Sequence[Judged], after: Sequence[Array], with_spread: bool = True) -> str:
    worse = np.mean([(a < c.before - WORSE_BY).mean() for a, c in zip(after, cars, strict=True)])
    means = [float(a.mean()) for a in after]
    return f"{_spread(means) if with_spread else f'{np.mean(means):.3f}'} ({100 * worse:.1f} %)"


def _spread(values: Sequence[float]) -> str:
    return f"{np.mean(values):.3f}" + (f" ± {np.std(values, ddof=1):.3f}" if values[1:] else "")


def _reliability(rows: Rows) -> str:
    """Table of predicted and true shares, in bins of the prediction."""
    pairs = [
        (probabilities(cars, row.model.car_is_there), outcomes(cars)) for row in rows.values() for cars in row.cars
    ]
    predicted, true = (np.concatenate(x) for x in zip(*pairs, strict=True))
    lines = []
    for low, high in pairwise(BINS):
        cells = []
        for column in range(2):
            within = (predicted[:, column] >= low) & ((predicted[:, column] < high) | (high == 1))
            figures = (
                f"{predicted[within, column].mean():.2f}, {true[within, column].mean():.2f}" if within.any() else ""
            )
            cells.append(f"{figures} ({within.sum()})")
        lines.append([f"{low:g} to {high:g}", *cells])
    head = "predicted", "better: predicted, true (cars)", "not worse: predicted, true (cars)"
    return markdown_table(head, lines)


def _coverage(rows: Rows) -> str:
    """Table of median true errors divided by the given standard deviations; 1 is right."""
    lines = []
    for (root, detector), row in rows.items():
        standard = np.concatenate([cars.standard for cars in row.cars])
        ratio = np.median(np.abs(standard[:, :4]), axis=0) * _TO_SIGMA
        lines.append([f"{root} {detector}", *(f"{x:.2f}" for x in ratio)])
    return markdown_table(("true over given sigma", *CAR_QUANTITIES[:4]), lines)


def _noises(models: Mapping[str, TrustModel]) -> str:
    rows = []
    for name, model in {**models, "package": bundled_trust_model()}.items():
        values = [f"{factor:.2f}, {floor:.3f} m" for factor, floor in zip(*model.image_noise, strict=True)]
        weights = ", ".join(f"{weight:.2f}" for weight in (*model.car_is_there.weights, model.car_is_there.bias))
        rows.append([name, *values, weights])
    return markdown_table(("images off by", *CAR_QUANTITIES, "weights"), rows)


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and run; return the exit code."""
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
    parser.add_argument("--set", nargs="+", default=[], metavar="KEY=VALUE", help="other settings")
    return run_command(parser, run, arguments)


if __name__ == "__main__":
    raise SystemExit(main())
