"""Options that all commands share which judge cars against labels."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from directshape_torch.cli.data_options import frame_id_of

if TYPE_CHECKING:
    from directshape_torch.evaluation.bootstrap import BootstrapSettings


def add_frame_choice(parser: argparse.ArgumentParser, default: str) -> None:
    """`--split` or `--frames`; `default` says which frames count without them."""
    chosen = parser.add_mutually_exclusive_group()
    chosen.add_argument("--split", type=Path, metavar="FILE", help=f"one frame id a line; default: {default}")
    chosen.add_argument("--frames", nargs="+", metavar="ID", type=frame_id_of, help="only these frames, e.g. 107 7322")


def add_interval_options(parser: argparse.ArgumentParser) -> None:
    """`--tracks`, `--seed` and `--draws` of intervals over physical cars."""
    parser.add_argument("--tracks", type=Path, metavar="FILE", help="JSON: which labels show the same physical car")
    parser.add_argument("--seed", type=int, default=0, help="of the bootstrap (default 0)")
    parser.add_argument("--draws", type=int, default=2000, help="of the bootstrap (default 2000)")


def bootstrap_settings(args: argparse.Namespace) -> BootstrapSettings:
    """What `--seed` and `--draws` ask for."""
    from directshape_torch.evaluation.bootstrap import BootstrapSettings

    return BootstrapSettings(num_draws=args.draws, seed=args.seed)
