"""This script compares every derivative of the energy three ways, in named regimes, with real image content.

For every term (silhouettes and tilt in both forms, photometric, points, all priors) the hand-derived Jacobian is
compared with autograd and with central differences (Richardson extrapolation over a sweep of steps), and the derivative
of its gradient by autograd with differences. Entries that differences cannot judge, by their own estimate of error, are
excluded and counted. A user's own term, `--term module:factory`, is examined like the built-in ones, and its shapes are
checked. The exit code is 1 if a bound is broken: analytic against autograd 1e-9, against numeric 1e-6, relative to the
norm of the row, float64; less than 2 percent excluded in the typical regime.

    python scripts/check_gradients.py --out gradients
    python scripts/check_gradients.py --term photometric silhouettes --regime typical near_3m --states 12
    python scripts/check_gradients.py --term my_terms:upright --regime typical
    python scripts/check_gradients.py --data KITTI --frame 000107 --out gradients_kitti

docs/gradients.md explains the columns.
"""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Sequence
from pathlib import Path

import torch
from command_line import run_command

from directshape_torch.errors import InputError
from directshape_torch.laboratory.regimes import regimes_named
from directshape_torch.laboratory.scenes import load_scene
from directshape_torch.laboratory.study import (
    SUBJECT_NAMES,
    StudyPlan,
    run_study,
    subjects_named,
    summary,
    write_report,
)
from directshape_torch.refinement.scene_problem import TermFactory
from directshape_torch.shape.pca_prior import PCAShapePrior


def load_factory(name: str) -> TermFactory:
    """The factory `(frames, detections, cars, prior) -> Term` of a user's own term, by "module:factory".

    Raises:
        InputError: there is no such module or factory.
    """
    module, _, attribute = name.partition(":")
    try:
        factory: TermFactory = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        cure = "give the name of a module that can be imported and of a function in it, as in my_terms:upright"
        raise InputError("--term", "module:factory", f"{name!r}: {error}", cure) from error
    return factory


def run(args: argparse.Namespace) -> int:
    """Examine, print and write; return the exit code.

    Raises:
        DirectShapeError: a name is unknown, a term has wrong shapes, or a data set cannot be read.
    """
    if args.states < 1:
        raise InputError("--states", "at least 1", f"{args.states}")
    names = SUBJECT_NAMES if args.term is None else args.term
    plan = StudyPlan(
        subjects=subjects_named([name for name in names if ":" not in name]),
        own_terms=tuple(load_factory(name) for name in names if ":" in name),
        regimes=tuple(regimes_named(args.regime)),
        num_states=args.states,
        seed=args.seed,
        pixels_per_car=args.pixels,
        second=args.second,
    )
    scene = load_scene(args.data, args.frame, args.detections, args.masks)
    prior = (PCAShapePrior.load_bundled() if args.prior is None else PCAShapePrior.load(args.prior)).double()
    study = run_study(scene, prior, plan, report=lambda line: print(line, file=sys.stderr))
    print(summary(scene.source, plan, study), end="")
    if args.out is not None:
        write_report(args.out, scene.source, plan, study)
    return 1 if study.broken_bounds() else 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and run; return 0 if all bounds hold, 1 if one is broken, 2 for wrong use."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--states", type=int, default=8, metavar="N", help="states in each regime (default 8: a minute)"
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="for jacobians.csv and summary.md")
    parser.add_argument("--term", nargs="+", metavar="NAME", help="default all; module:factory for one of your own")
    parser.add_argument("--regime", nargs="+", metavar="NAME", help="default all")
    parser.add_argument("--data", type=Path, metavar="ROOT", help="KITTI's layout; default the bundled demo frame")
    parser.add_argument("--frame", metavar="ID", help="frame of --data; default the one with most masked cars")
    parser.add_argument("--detections", type=Path, metavar="DIR", help="default the first folder in ROOT/detections")
    parser.add_argument("--masks", type=Path, metavar="DIR", help="default ROOT/training/masks")
    parser.add_argument("--prior", type=Path, metavar="FILE", help="default the bundled shape prior")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--pixels", type=int, default=24, metavar="N", help="pixels per car and side (default 24)")
    parser.add_argument("--second", action=argparse.BooleanOptionalAction, default=True, help="second derivatives too")
    torch.set_num_threads(1)  # the operations are small, and threads would spin
    return run_command(parser, run, arguments)


if __name__ == "__main__":
    raise SystemExit(main())
