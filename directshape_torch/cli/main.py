"""This module is the program `directshape`: it runs a command and turns errors into one line and an exit code."""

from __future__ import annotations

import argparse
import importlib
import os
import signal
import sys
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from directshape_torch.batch.refine_dataset import package_version
from directshape_torch.errors import DirectShapeError, PriorWarning
from directshape_torch.files.atomic_files import check_file

EXIT_WRONG_INPUT = 2
EXIT_INTERRUPTED = 130
EXIT_OUTPUT_CLOSED = 141
EXIT_TERMINATED = 143

# Each module has a docstring with the help of the command, `add_options(parser)` and `run(args) -> int`, whose errors
# `main` shows.
COMMANDS = (
    "refine",
    "status",
    "demo",
    "compare",
    "report",
    "evaluate",
    "evaluate_shape",
    "build_prior",
    "calibrate_rig",
    "export",
    "inspect",
    "check_data",
    "fit_shape",
)

_DESCRIPTION = "Refine pose and shape of cars in stereo frames by differentiable rendering of signed distance fields."


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program.

    Args:
        arguments: words of the command line. Default: the words of the process.

    Returns:
        The exit code (docs/file_formats.md): 0 success, 1 finished with failures, 2 wrong usage or input.
    """
    parser = make_parser()
    args = parser.parse_args(arguments)
    if not hasattr(args, "run"):
        parser.print_help(sys.stderr)
        return EXIT_WRONG_INPUT
    try:
        # A page or table that cannot be written is refused before any work.
        for name in ("html", "json", "csv"):
            if isinstance(path := getattr(args, name, None), Path) and str(path) != "-":
                check_file(f"--{name}", path)
        with _terminable(), _plain_warnings():
            code: int = args.run(args)
        sys.stdout.flush()
    except (DirectShapeError, OSError) as error:
        if isinstance(error, BrokenPipeError) and _output_was_closed():
            return EXIT_OUTPUT_CLOSED
        # An OSError is a full disk or a folder without permission, for which a traceback is of no use.
        print(f"directshape: error: {' '.join(str(error).split())}", file=sys.stderr)
        return EXIT_WRONG_INPUT
    except _TerminatedError:
        print("directshape: terminated", file=sys.stderr)
        return EXIT_TERMINATED
    except KeyboardInterrupt:
        print("directshape: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    return code


class _TerminatedError(KeyboardInterrupt):
    """The process was asked to end."""


@contextmanager
def _terminable() -> Iterator[None]:
    """Let SIGTERM end the body like Ctrl-C, so that a run records its stop."""

    def end(*_: object) -> None:
        raise _TerminatedError("SIGTERM")

    # Only the main thread may set signal handlers.
    is_ours = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGTERM, end) if is_ours else None
    try:
        yield
    finally:
        if is_ours:
            signal.signal(signal.SIGTERM, before)


@contextmanager
def _plain_warnings() -> Iterator[None]:
    """Show warnings about priors in one line, without a place in the code, as errors are shown."""
    with warnings.catch_warnings():
        otherwise = warnings.showwarning

        def show(message: Warning | str, category: type[Warning], *place: Any, **more: Any) -> None:
            if issubclass(category, PriorWarning):
                print(f"warning: {message}", file=sys.stderr)
            else:
                otherwise(message, category, *place, **more)

        warnings.showwarning = show
        yield


def _output_was_closed() -> bool:
    """Whether the reader of the output has closed it, as after `| head`; if so, discard further output."""
    try:
        # The text that failed is discarded, so only another write shows whether this pipe is broken.
        print(flush=True)
    except BrokenPipeError:
        # Otherwise the interpreter would write again at its end and print an error.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return True
    return False


def make_parser() -> argparse.ArgumentParser:
    """The parser of the program with all of its commands."""
    parser = argparse.ArgumentParser(prog="directshape", description=_DESCRIPTION)
    parser.add_argument("--version", action="version", version=package_version())
    subparsers = parser.add_subparsers(title="commands", metavar="COMMAND")
    for name in COMMANDS:
        module = importlib.import_module(f"directshape_torch.cli.{name}")
        title, _, description = (module.__doc__ or "").partition("\n\n")
        words = title.partition(": ")[2].rstrip(".")
        command = subparsers.add_parser(name.replace("_", "-"), help=words, description=description)
        module.add_options(command)
        command.set_defaults(run=module.run)
    return parser


if __name__ == "__main__":
    sys.exit(main())
