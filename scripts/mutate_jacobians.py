"""Does the test suite notice a mistake in a hand-derived Jacobian? Makes such mistakes and looks.

Every arithmetic node, component and axis of the functions that hold derivatives is changed, one at a time (sign flip,
dropped factor, dropped term, swapped axis); each mutant must be caught by the tests named for that function. Prints
mutant, verdict and the test that caught it; exit code 1 where a mutant survives. The checkout is never edited.

    python scripts/mutate_jacobians.py [--target NAME ...] [--sample N --seed S] [--json FILE] [--processes 2]
"""

from __future__ import annotations

import argparse
import random
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from jacobian_mutants.equivalents import reason_for
from jacobian_mutants.mutants import Mutant, mutants_of
from jacobian_mutants.report import summary, table, write_json
from jacobian_mutants.runner import MutationRunner, Outcome, UnmutatedFailureError
from jacobian_mutants.targets import TARGETS, Target
from tqdm import tqdm

ROOT = Path(__file__).resolve().parents[1]


def all_mutants(root: Path, targets: dict[str, Target]) -> list[tuple[str, Mutant]]:
    """Every mutant (target, mutant) of the targets, the equivalent ones included."""
    return [
        (name, mutant)
        for name, target in targets.items()
        for mutant in mutants_of(target.path, (root / target.path).read_bytes(), target.functions)
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; see the module's description."""
    options = _parser().parse_args(arguments)
    targets = {name: TARGETS[name] for name in options.target or TARGETS}
    everything = all_mutants(ROOT, targets)
    mutants = [(name, mutant) for name, mutant in everything if reason_for(mutant) is None]
    excluded = Counter(reason_for(mutant) for _, mutant in everything if reason_for(mutant) is not None)
    if options.sample is not None:
        mutants = random.Random(options.seed).sample(mutants, min(options.sample, len(mutants)))
    # In a log file a line every half minute is enough.
    interval_s = 0.1 if sys.stderr.isatty() else 30.0
    with tqdm(
        total=len(mutants), unit="mutant", file=sys.stderr, mininterval=interval_s, maxinterval=interval_s
    ) as bar:

        def finished(outcome: Outcome) -> None:
            if outcome.verdict == "survived":
                bar.write(f"SURVIVED {outcome.mutant}", file=sys.stderr)
            bar.update()

        tests_of = {name: target.tests for name, target in targets.items()}
        try:
            outcomes = MutationRunner(ROOT, options.processes).run(mutants, tests_of, finished)
        except UnmutatedFailureError as error:
            print(error, file=sys.stderr)
            return 2
    print(table(outcomes))
    print(summary(outcomes, excluded))
    if options.json is not None:
        write_json(options.json, outcomes, excluded)
    return 0 if all(outcome.verdict in ("caught", "timed out") for outcome in outcomes) else 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--target", action="append", choices=TARGETS, help="only this one; may be given several times")
    parser.add_argument("--sample", type=int, default=None, metavar="N", help="only N mutants, drawn at random")
    parser.add_argument("--seed", type=int, default=0, help="of the draw (default 0)")
    parser.add_argument("--json", type=Path, default=None, metavar="FILE", help="also write the outcomes to a file")
    parser.add_argument("--processes", type=int, default=2, help="mutants at once (default 2)")
    return parser


if __name__ == "__main__":
    sys.exit(main())
