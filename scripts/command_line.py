"""This module has what scripts share: the run with its exit code, and tables in Markdown."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable, Sequence

from directshape_torch.errors import DirectShapeError

WRONG_USE = 2


def run_command(
    parser: argparse.ArgumentParser,
    run: Callable[[argparse.Namespace], int | None],
    arguments: Sequence[str] | None = None,
) -> int:
    """Parse the command line (None: of the process) and run; errors of input are printed on stderr.

    Returns:
        The exit code: the result of `run` (None is 0), or 2 for wrong input.
    """
    args = parser.parse_args(arguments)
    try:
        return run(args) or 0
    except DirectShapeError as error:
        print(f"error: {error}", file=sys.stderr)
        return WRONG_USE


def markdown_table(head: Sequence[object], rows: Iterable[Sequence[object]]) -> str:
    """Lines of a table in Markdown from its head and its rows, without a line end."""
    first, *rest = ("| " + " | ".join(map(str, row)) + " |" for row in (head, *rows))
    return "\n".join([first, "|" + "---|" * len(head), *rest])
