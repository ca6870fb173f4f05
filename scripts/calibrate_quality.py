"""Calibrates the figures of trust on refined cars with truth: probabilities, sigmas, and the acceptance policy.

    R=$DIRECTSHAPE_DATA/rendered; K=$DIRECTSHAPE_DATA/kitti
    python scripts/calibrate_quality.py --data $R --exact $R/detections/gt --masks $R/training/masks $R/masks_degraded
        --other $K $K/detections/noisy_stereo $K/training/masks --other $K $K/detections/noisy_mono $K/training/masks
        --set compile=on --out out/trust --model directshape_torch/assets/trust_model.json

Each seed is a run of each of four detectors, whose detections are drawn around exact ones: through an exact rig, and
through two whose disparities and rows are off, one of them with left masks alone. The run estimates rig and detector
and refines, every result being returned. Outcome: did the bird's-eye overlap of the box with the label grow, and did it
not fall by more than 0.05. Two logistic regressions read a few columns of `result.quality.evidence`; factors and floors
bring the covariance into true units. Every figure of the report is of cars whose frame the fit has not seen (12 folds
of frames); the model that is written is fitted to all of them. `--other` names real frames that are judged and never
fitted. The refined cars are kept in OUT, so that a second call only fits.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from command_line import run_command
from quality_calibration.fit import calibrated, cross_validated, fit_head, fit_sigmas, in_view
from quality_calibration.noise import LEVELS
from quality_calibration.observations import WORSE_BY, Array, Observations, observe_dataset, observe_noisy
from quality_calibration.report import (
    Judged,
    Thresholds,
    choose_thresholds,
    coverage_table,
    policy_table,
    probability_table,
)

from directshape_torch.cli.options import frame_id_of
from directshape_torch.config import AcceptanceConfig
from directshape_torch.io.config_files import load_config
from directshape_torch.io.stereo_dataset import open_dataset
from directshape_torch.refinement.quality import TrustModel
from directshape_torch.refiner import DirectShapeRefiner, KnownRig
from directshape_torch.rig.from_files import estimate_rigs
from directshape_torch.rig.rigs import RigEstimates

EVERYTHING = AcceptanceConfig(min_probability_better=0.0, min_probability_not_worse=0.0)
# The detectors whose share of worse cars the default policy is to bring below the bound: those of the development data.
USUAL_LEVELS = ("stereo", "mono")
# For a detector that is already good, whose boxes a refinement spoils more easily.
STRICT = Thresholds(0.8, 0.9)


def refiner(overrides: Sequence[str], rig: KnownRig) -> DirectShapeRefiner:
    """The default settings but for `overrides`, every result returned."""
    return DirectShapeRefiner(config=replace(load_config(None, overrides), acceptance=EVERYTHING), rig=rig)


def development_cars(args: argparse.Namespace) -> Observations:
    """Refined cars of drawn detections, from OUT where they are there already."""
    parts = []
    for masks in args.masks:
        kept = args.out / f"{'_'.join(['cars', masks.name, *map(str, args.seeds), *args.set])}.npz"
        if not kept.is_file():
            dataset = open_dataset("kitti", args.data, args.exact, masks, frames=args.frames)
            make = partial(refiner, args.set)
            observe_noisy(dataset, make, LEVELS, args.seeds, masks.name, _tell).save(kept)
        parts.append(Observations.load(kept))
    return Observations.joined(parts)


def other_cars(args: argparse.Namespace, root: Path, detections: Path, masks: Path) -> tuple[str, Observations]:
    """Refined cars of real frames."""
    name = f"{root.name} {detections.name}"
    kept = args.out / f"{'_'.join(['cars', root.name, detections.name, *args.set])}.npz"
    if not kept.is_file():
        dataset = open_dataset("kitti", root, detections, masks)
        rigs = RigEstimates(estimate_rigs(dataset, lambda frame: _tell(f"{name}: {frame} looked at")))
        observe_dataset(dataset, refiner(args.set, rigs), name).save(kept)
    return name, Observations.load(kept)


# Found by forward selection on the cross-validated log loss of the development cars; of columns that say the same one
# is kept, and none whose weight would have the wrong sign for what it means.
BETTER = (
    "relative_decrease",
    "log_detector_sigma",
    "turned",
    "log_expected_gain",
    "log_sigma_yaw",
    "log_profile_contrast",
    "mask_misfit_left",
)
NOT_WORSE = ("relative_decrease", "turned", "log_sigma_yaw", "mask_misfit_left", "log_profile_fall_before")


def fitted(cars: Observations, provenance: dict[str, object]) -> TrustModel:
    """The model of some cars."""
    better = fit_head(cars.evidence, cars.is_better, BETTER)
    not_worse = fit_head(cars.evidence, ~cars.is_worse, NOT_WORSE)
    return TrustModel(better, not_worse, *fit_sigmas(*in_view(cars)), provenance)


def predictions(model: TrustModel, cars: Observations) -> Array:
    """Both probabilities and the four calibrated sigmas, (N, 6)."""
    evidence = torch.from_numpy(cars.evidence)
    sigmas = calibrated(in_view(cars)[1], model.sigma_factors, model.sigma_floors)
    return np.column_stack([model.better(evidence).numpy(), model.not_worse(evidence).numpy(), sigmas])


def judged(name: str, cars: Observations, predicted: Array) -> Judged:
    """Cars with predictions (N, 6)."""
    return Judged(name, cars, predicted[:, :2], in_view(cars)[0], predicted[:, 2:])


def judged_others(args: argparse.Namespace, model: TrustModel) -> list[Judged]:
    """The real frames."""
    found = (other_cars(args, *paths) for paths in args.other)
    return [judged(name, cars, predictions(model, cars)) for name, cars in found]


def levels_of(everything: Judged, name: str) -> list[Judged]:
    """All drawn cars, those of the usual detectors, and those of each level by itself."""
    levels = np.array([source.partition(",")[0] for source in everything.observations.source.tolist()])
    usual = everything.where(np.isin(levels, USUAL_LEVELS), f"{name}, {' and '.join(USUAL_LEVELS)}")
    drawn = [level.name for level in LEVELS if (levels == level.name).any()]
    return [everything, usual, *(everything.where(levels == level, f"{name}, {level}") for level in drawn)]


def run(args: argparse.Namespace) -> None:
    """Refine, fit, judge and write."""
    torch.set_num_threads(args.threads)
    args.out.mkdir(parents=True, exist_ok=True)
    cars = development_cars(args)
    model = fitted(cars, _provenance(cars, args.set))
    held_out = cross_validated(cars, lambda train, test: predictions(fitted(train, {}), test))
    everything, usual, *levels = levels_of(judged("rendered, all", cars, held_out), "rendered")
    groups = [everything, usual, *levels, *judged_others(args, model)]
    model.save(args.model or args.out / "trust_model.json")
    chosen = choose_thresholds(usual)
    parts = (
        probability_table(groups),
        f"Thresholds of highest mean IoU below 2 % worse, {usual.name}: {chosen}",
        policy_table(groups, [Thresholds(0.0, 0.0), chosen, STRICT]),
        f"Factors and floors of the sigmas: {fit_sigmas(*in_view(cars))}",
        coverage_table(groups),
    )
    report = "\n\n".join(parts)
    (args.out / "report.md").write_text(report + "\n", encoding="utf-8")
    print(report)


def _provenance(cars: Observations, overrides: Sequence[str]) -> dict[str, object]:
    return {
        "made_by": "scripts/calibrate_quality.py",
        "cars": len(cars),
        "frames": len(set(cars.group.tolist())),
        "sources": sorted(set(cars.source.tolist())),
        "settings": " ".join(["configs/default.yaml", *overrides]),
        "worse_by": WORSE_BY,
    }


def _tell(message: str) -> None:
    print(message, file=sys.stderr, flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and run; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, metavar="ROOT", help="folder that holds training/")
    parser.add_argument("--exact", type=Path, required=True, metavar="DIR", help="labels as result files")
    parser.add_argument("--masks", type=Path, nargs="+", required=True, metavar="DIR")
    parser.add_argument("--frames", nargs="+", metavar="ID", type=frame_id_of, help="default all")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument(
        "--other",
        type=Path,
        nargs=3,
        action="append",
        default=[],
        metavar=("ROOT", "DETECTIONS", "MASKS"),
        help="real frames, judged and never fitted; may be repeated",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument("--model", type=Path, metavar="FILE", help="default OUT/trust_model.json")
    parser.add_argument(
        "--set", nargs="+", default=[], metavar="KEY=VALUE", help="other settings than those of the default"
    )
    parser.add_argument("--threads", type=int, default=1)
    return run_command(parser, run, arguments)


if __name__ == "__main__":
    raise SystemExit(main())
