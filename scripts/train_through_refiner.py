"""Trains a small network THROUGH the refiner and judges it on frames that it has not seen.

    python scripts/train_through_refiner.py --data $DIRECTSHAPE_DATA/rendered --out out/trained

In front of the refiner stands a network that sees crops of images and masks and the detector's box, and proposes for
each car factors of the terms (`--net weights`), a residual on the logits of its masks (`--net masks`), or `both`.
Behind it stands a loss on the refined box, and the gradient comes back through the refinement (`--mode`). The baseline
is the same correction as a constant for all cars, trained in the same way on the same frames.

Frames are dealt into folds by a seeded shuffle; each fold is judged by the training on the others, with the unchanged
default settings. The training itself uses `fast.yaml` with 200 pixels a car and side and unrolls three iterations.
Writes `summary.md`, `cars.csv`, `learning_curve.png` and the parameters of each fold as safetensors. The same seed
gives the same parameters and figures on one machine.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import torch
from command_line import run_command
from refiner_training.jobs import Job, Options, Outcome, run_jobs
from refiner_training.report import csv_text, learning_curve_png, markdown
from refiner_training.training import TrainingSettings

from directshape_torch.files.atomic_files import write_bytes, write_text
from directshape_torch.shape.tensor_file import write_tensors

SCHEMA = "directshape_torch.trained_correction/1"


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and run; returns the exit code."""
    torch.set_num_threads(1)
    return run_command(_parser(), lambda args: run(_options(args), args.out, args.processes), arguments)


def run(options: Options, out: Path, processes: int) -> None:
    """Train, judge and write everything."""
    started = time.perf_counter()
    jobs = [Job("fixed", 0)]
    for kind in ("constant", "network"):
        jobs += [Job(kind, fold) for fold in range(options.folds)]
    outcomes = run_jobs(jobs, options, processes)
    report = markdown(outcomes, options, time.perf_counter() - started)
    write_text(out / "summary.md", report)
    write_text(out / "cars.csv", csv_text(outcomes, options))
    write_bytes(out / "learning_curve.png", learning_curve_png(outcomes))
    for outcome in outcomes:
        _write_parameters(out, outcome, options)
    print(report)


def _write_parameters(out: Path, outcome: Outcome, options: Options) -> None:
    if outcome.parameters:
        description = {"schema": SCHEMA, "kind": outcome.job.kind, "parts": options.parts, "fold": outcome.job.fold}
        write_tensors(out / f"{outcome.job.kind}_{outcome.job.fold}.safetensors", outcome.parameters, description)


def _options(args: argparse.Namespace) -> Options:
    training = TrainingSettings(args.epochs, args.rate, args.weight_decay, args.frames_per_step, args.seed)
    return Options(
        data=args.data,
        detections=args.detections or args.data / "detections" / "mono",
        masks=args.masks or args.data / "masks_degraded",
        frames=None if args.frames is None else tuple(args.frames),
        parts=args.net,
        mode=args.mode,
        folds=args.folds,
        constant_rate=args.constant_rate,
        network_rate=args.rate,
        training=training,
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, metavar="ROOT", help="folder that holds training/")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument("--detections", type=Path, metavar="DIR", help="default ROOT/detections/mono")
    parser.add_argument("--masks", type=Path, metavar="DIR", help="default ROOT/masks_degraded")
    parser.add_argument("--frames", nargs="+", metavar="ID", help="default all")
    parser.add_argument("--net", choices=("weights", "masks", "both"), default="both", help="what is corrected")
    parser.add_argument("--mode", choices=("unroll", "implicit", "implicit_gauss_newton"), default="unroll")
    parser.add_argument("--epochs", type=int, default=8)
    parser.add_argument("--folds", type=int, default=2)
    parser.add_argument("--frames-per-step", type=int, default=2)
    parser.add_argument("--rate", type=float, default=1e-2, help="of the network")
    parser.add_argument("--constant-rate", type=float, default=5e-2, help="of the constants")
    parser.add_argument("--weight-decay", type=float, default=1e-2, help="of the network")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--processes", type=int, default=2)
    return parser


if __name__ == "__main__":
    raise SystemExit(main())
