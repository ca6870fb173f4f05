"""This script compares every derivative of the energy three ways, in named regimes, with real image content.

For every term (silhouettes and tilt in both forms, photometric, points, all priors) the hand-derived Jacobian is
compared with autograd and with central differences (Richardson extrapolation over a sweep of steps), and the derivative
of its gradient by autograd with differences. Entries that differences cannot judge, by their own estimate of error, are
excluded and counted. A user's own term, `--term module:factory`, is examined like the built-in ones, and its shapes are
checked. The exit code is 1 if a bound is broken: analytic against autograd 1e-9, against numeric 1e-6, relative to the
norm of the row, float64; less than 2 percent excluded in the typical regime.

    python scripts/check_gradients.py > gradients.md
    python scripts/check_gradients.py --term photometric silhouettes --regime typical near_3m --states 12
    python scripts/check_gradients.py --term my_terms:upright --regime typical

docs/gradients.md explains the columns.
"""

from __future__ import annotations

import argparse
import importlib
import sys
from collections import Counter
from collections.abc import Sequence

import torch
from command_line import markdown_table, run_command

from directshape_torch.errors import InputError
from directshape_torch.laboratory.bench import TERM_NAMES, TRACK_NAMES, Bench
from directshape_torch.laboratory.comparison import BOUNDS, Comparison, compare
from directshape_torch.laboratory.experiments import AT_FIXED_DEPTHS, gradient_experiment, term_experiment
from directshape_torch.laboratory.regimes import REGIMES
from directshape_torch.laboratory.scenes import load_scene
from directshape_torch.refinement.scene_problem import TermFactory
from directshape_torch.shape.pca_prior import PCAShapePrior

SUBJECT_NAMES = (*TERM_NAMES, *TRACK_NAMES)


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
    """Examine and print; return the exit code.

    Raises:
        DirectShapeError: a name is unknown, a term has wrong shapes, or no regime has any of the terms.
    """
    if args.states < 1:
        raise InputError("--states", "at least 1", f"{args.states}")
    subjects = [name for name in args.term if ":" not in name]
    for what, known, names in (("term", SUBJECT_NAMES, subjects), ("regime", REGIMES, args.regime)):
        if unknown := [name for name in names if name not in known]:
            raise InputError(what, f"one of {', '.join(known)}", repr(unknown[0]))
    own_terms = [load_factory(name) for name in args.term if ":" in name]
    scene, prior = load_scene(), PCAShapePrior.load_bundled().double()
    comparisons: list[Comparison] = []
    notes = []
    for regime in args.regime:
        bench = Bench.build(scene, prior, REGIMES[regime], args.states, 0, args.pixels, own_terms)
        if empty := int((bench.rays_per_car == 0).sum()):
            notes.append(f"{regime}: {empty} of {args.states} states see no valid pixel; only their priors count.")
        own = [name for name in bench.terms if name not in SUBJECT_NAMES]
        found = compare_subjects(bench, [*subjects, *own], args.second)
        comparisons += found
        worst = max((c.errors["analytic-numeric"] for c in found), default=0.0)
        print(f"{regime}: {len(found)} subjects, analytic-numeric at most {worst:.0e}", file=sys.stderr)
    if not comparisons:
        expected = f"one that has {', '.join(subjects)}"
        raise InputError("regime", expected, ", ".join(args.regime), "examine it in track")
    broken = [sentence for c in comparisons for sentence in c.broken_bounds()]
    parts = [
        "# Jacobians three ways",
        f"Images: the bundled demo frame. {args.states} states in each of {len(args.regime)} regimes, seed 0. "
        "Errors are relative to the norm of the row. Bounds in float64: "
        + ", ".join(f"{pair} {bound:.0e}" for pair, bound in BOUNDS.items())
        + ".",
        "**All bounds hold.**" if not broken else "**Broken bounds:**\n\n" + "\n".join(f"- {b}" for b in broken),
        *notes,
        "## Largest errors over all regimes, float64",
        worst_table(comparisons),
        "## Entries that differences cannot judge",
        exclusion_table(comparisons),
    ]
    print("\n\n".join(parts))
    return 1 if broken else 0


@torch.no_grad()
def compare_subjects(bench: Bench, names: Sequence[str], second: bool) -> list[Comparison]:
    """Compare three Jacobians of the named terms at the states of a bench; `second` adds the terms' gradients."""
    terms = [name for name in names if name in bench.terms]
    experiments = [term_experiment(bench, terms)] if terms else []
    twice = [name for name in terms if name not in AT_FIXED_DEPTHS]
    experiments += [gradient_experiment(bench, twice)] if second and twice else []
    return [c for experiment in experiments for c in compare(experiment, bench.regime.name)]


def worst_table(comparisons: Sequence[Comparison]) -> str:
    """Table of the largest errors of each subject."""
    rows = []
    for name in dict.fromkeys(c.name for c in comparisons):
        own = [c for c in comparisons if c.name == name]
        errors = [f"{max(c.errors[pair] for c in own):.1e}" for pair in BOUNDS]
        worst = max(own, key=lambda c: c.errors["analytic-numeric"]).regime
        excluded = sum(sum(c.excluded.values()) for c in own)
        share = f"{excluded} ({100 * excluded / max(1, sum(c.entries for c in own)):.2f} %)"
        rows.append([name, sum(c.compared for c in own), share, *errors, worst])
    return markdown_table(["subject", "compared", "excluded", *BOUNDS, "worst regime (numeric)"], rows)


def exclusion_table(comparisons: Sequence[Comparison]) -> str:
    """Table of the excluded entries of each regime, with reasons."""
    rows = []
    for regime in dict.fromkeys(c.regime for c in comparisons):
        own = [c for c in comparisons if c.regime == regime]
        counts: Counter[str] = Counter()
        for c in own:
            counts.update(c.excluded)
        entries = sum(c.entries for c in own)
        worst = max(own, key=lambda c: c.excluded_share)
        reasons = ", ".join(f"{reason} {count}" for reason, count in counts.most_common())
        most = f"{worst.name} {100 * worst.excluded_share:.2f} %"
        share = f"{100 * counts.total() / max(entries, 1):.2f} %"
        rows.append([regime, REGIMES[regime].explanation, entries, share, most, reasons or "none"])
    return markdown_table(["regime", "states", "entries", "excluded", "most in", "why"], rows)


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and run; return 0 if all bounds hold, 1 if one is broken, 2 for wrong use."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--states", type=int, default=8, metavar="N", help="states in each regime (default 8: a minute)"
    )
    own = "default all; module:factory for one of your own"
    parser.add_argument("--term", nargs="+", default=SUBJECT_NAMES, metavar="NAME", help=own)
    parser.add_argument("--regime", nargs="+", default=list(REGIMES), metavar="NAME", help="default all")
    parser.add_argument("--pixels", type=int, default=24, metavar="N", help="pixels per car and side (default 24)")
    parser.add_argument("--second", action=argparse.BooleanOptionalAction, default=True, help="second derivatives too")
    torch.set_num_threads(1)  # the operations are small, and threads would spin
    return run_command(parser, run, arguments)


if __name__ == "__main__":
    raise SystemExit(main())
