"""How every script ends: with its exit code, and with one line for input that it cannot use."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence

from directshape_torch.errors import DirectShapeError

WRONG_USE = 2


def run_command(
    parser: argparse.ArgumentParser,
    run: Callable[[argparse.Namespace], int | None],
    arguments: Sequence[str] | None = None,
) -> int:
    """Parse the command line (None: the process's own) and run; wrong input is told on stderr.

    Returns:
        The exit code: what `run` returns (None is 0), or 2 for wrong input.
    """
    args = parser.parse_args(arguments)
    try:
        return run(args) or 0
    except DirectShapeError as error:
        print(f"error: {error}", file=sys.stderr)
        return WRONG_USE
