"""This script makes mistakes in hand-derived Jacobians and checks that the tests notice them.

Every arithmetic node, component and axis of the functions with derivatives is changed, one at a time (sign flip,
dropped factor, dropped term, swapped axis); each mutant must be caught by the tests named for that function. The script
prints mutant, verdict and the test that caught it; the exit code is 1 if a mutant survives. The checkout is never
edited.

    python scripts/mutate_jacobians.py [--target NAME ...] [--sample N --seed S] [--processes 2]
"""

from __future__ import annotations

import argparse
import random
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from jacobian_mutants.mutants import Mutant, mutants_of
from jacobian_mutants.runner import Outcome, UnmutatedFailureError, run_mutants
from jacobian_mutants.targets import TARGETS, Target, reason_for
from tqdm import tqdm

# Messages of failed comparisons begin like this, in pytest's own asserts and in those of torch.
_WRONG_NUMBER = ("AssertionError", "assert", "Failed", "GradcheckError", "torch.autograd.gradcheck")
ROOT = Path(__file__).resolve().parents[1]


def all_mutants(root: Path, targets: dict[str, Target]) -> list[tuple[str, Mutant]]:
    """Every mutant (target, mutant) of the targets, including the equivalent ones."""
    return [
        (name, mutant)
        for name, target in targets.items()
        for mutant in mutants_of(target.path, (root / target.path).read_bytes(), target.functions)
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and run; return the exit code."""
    options = _parser().parse_args(arguments)
    targets = {name: TARGETS[name] for name in options.target or TARGETS}
    everything = all_mutants(ROOT, targets)
    excluded = Counter(reason for _, mutant in everything if (reason := reason_for(mutant)) is not None)
    mutants = [(name, mutant) for name, mutant in everything if reason_for(mutant) is None]
    if options.sample is not None:
        mutants = random.Random(options.seed).sample(mutants, min(options.sample, len(mutants)))
    # In a log file a line every half minute is enough.
    interval_s = 0.1 if sys.stderr.isatty() else 30.0
    with tqdm(total=len(mutants), unit="mutant", mininterval=interval_s, maxinterval=interval_s) as bar:

        def finished(outcome: Outcome) -> None:
            bar.write("\n    ".join(told(outcome)))
            bar.update()

        tests_of = {name: target.tests for name, target in targets.items()}
        try:
            outcomes = run_mutants(ROOT, mutants, tests_of, options.processes, finished)
        except UnmutatedFailureError as error:
            print(error, file=sys.stderr)
            return 2
    print(summary(outcomes))
    for reason, number in excluded.items():
        print(f"excluded as equivalent, {number}: {reason}")
    return 0 if all(outcome.verdict in ("caught", "timed out") for outcome in outcomes) else 1


def told(outcome: Outcome) -> tuple[str, str]:
    """Place and change of the mutant; verdict and the test that gave it."""
    m = outcome.mutant
    where = f"{m.path}:{m.line} {m.function}: {m.kind}: {_short(m.before)} -> {_short(m.after)}"
    if outcome.verdict != "caught":
        return where, f"{outcome.verdict.upper()} {outcome.error}".rstrip()
    how = "" if is_wrong_number(outcome) else f" (crashes: {_short(outcome.error)})"
    return where, f"caught by {outcome.caught_by or 'the process'}{how}"


def summary(outcomes: Sequence[Outcome]) -> str:
    """Text with the counts of verdicts."""
    crashed = sum(outcome.verdict == "caught" and not is_wrong_number(outcome) for outcome in outcomes)
    count = Counter(outcome.verdict for outcome in outcomes)
    return (
        f"{len(outcomes)} mutants: {count['caught']} caught ({crashed} of them because they crash), "
        f"{count['timed out']} timed out, {count['survived']} survived, {count['no verdict']} without a verdict"
    )


def is_wrong_number(outcome: Outcome) -> bool:
    """Whether a test saw a wrong result rather than an exception inside the mutant."""
    return outcome.error.startswith(_WRONG_NUMBER)


def _short(text: str) -> str:
    line = " ".join(text.split())
    return line if len(line) <= 90 else f"{line[:87]}..."


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--target", action="append", choices=TARGETS, help="only this one; may be given several times")
    parser.add_argument("--sample", type=int, default=None, metavar="N", help="only N mutants, drawn at random")
    parser.add_argument("--seed", type=int, default=0, help="of the draw (default 0)")
    parser.add_argument("--processes", type=int, default=2, help="mutants at once (default 2)")
    return parser


if __name__ == "__main__":
    sys.exit(main())
