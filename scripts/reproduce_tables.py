"""The paper's experiments, one command each: pose, ablation.

    export DIRECTSHAPE_DATA=...                      # or --data ROOT, a full KITTI with detections and masks
    python scripts/reproduce_tables.py pose          # AP before and after: ours, the geometric baseline, both together
    python scripts/reproduce_tables.py ablation      # scripts/paper_tables/rows.py, row by row

Which folders a data set has: scripts/paper_tables/data_sets.py. Written to --out: NAME.md, NAME_*.csv, and under runs/
every refinement, as `directshape refine` writes it. Refinements are kept: a second call makes tables only, and one that
was stopped goes on. They are told apart by settings, prior, stereo field and masks, not by the program's code: after a
change of that, choose another --out. --quick tries everything in a minute or two (two frames, one row of each group).
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from command_line import run_command
from paper_tables.data_sets import DataSet, field_file, find_data_sets
from paper_tables.rows import ROWS
from paper_tables.runs import Experiment
from paper_tables.tables import make_ablation_table, make_pose_table

from directshape_torch.errors import InputError
from directshape_torch.evaluation.bootstrap import BootstrapSettings

TABLES: dict[str, Callable[[Experiment], None]] = {
    "pose": make_pose_table,
    "ablation": make_ablation_table,
}


def chosen_data_sets(args: argparse.Namespace) -> tuple[DataSet, ...]:
    """The data sets that the options name.

    Raises:
        InputError: no data, or an unknown name.
    """
    root = args.data or os.environ.get("DIRECTSHAPE_DATA")
    if not root:
        raise InputError("--data", "a folder in KITTI's layout", "none", "or set DIRECTSHAPE_DATA")
    found = find_data_sets(Path(root), args.masks)
    unknown = sorted(set(args.sets or ()) - set(found))
    if unknown:
        raise InputError("--sets", f"names among {', '.join(found)}", ", ".join(unknown))
    # Rendered scenes first, where the truth is exact.
    chosen = [data_set for name, data_set in found.items() if not args.sets or name in args.sets]
    return tuple(sorted(chosen, key=lambda data_set: not data_set.has_exact_truth))


def run(args: argparse.Namespace) -> None:
    """Make one experiment's tables."""
    torch.set_num_threads(args.threads)
    data_sets = chosen_data_sets(args)
    given = None if args.stereo_bias in ("none", "auto") else Path(args.stereo_bias)
    experiment = Experiment(
        out=args.out,
        data_sets=data_sets,
        fields={
            d.name: field_file(d.root, args.out / "fields") if args.stereo_bias == "auto" else given for d in data_sets
        },
        device=args.device,
        frames=None if args.frames is None else tuple(frame.zfill(6) for frame in args.frames),
        detectors=None if args.detections is None else tuple(args.detections),
        bootstrap=BootstrapSettings(num_draws=args.draws, seed=args.seed),
        quick=args.quick,
        groups=tuple(args.groups),
    )
    TABLES[args.table](experiment)
    print(f"{args.out / args.table}.md")


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and run; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", choices=tuple(TABLES))
    parser.add_argument("--data", type=Path, metavar="ROOT", help="default: DIRECTSHAPE_DATA")
    parser.add_argument("--out", type=Path, default=Path("out/tables"), metavar="DIR", help="default: %(default)s")
    parser.add_argument("--sets", nargs="+", metavar="NAME", help="data sets below ROOT; default all")
    parser.add_argument("--detections", nargs="+", metavar="NAME", help="folders of detections/; default the table's")
    parser.add_argument("--frames", nargs="+", metavar="ID", help="default all")
    parser.add_argument("--masks", type=Path, metavar="DIR", help="instead of the data set's own")
    parser.add_argument(
        "--stereo-bias", default="auto", metavar="FILE|auto|none", help="auto fits it, where all frames are of one rig"
    )
    parser.add_argument("--quick", action="store_true", help="two frames of each detector, one row of each group")
    parser.add_argument(
        "--groups",
        nargs="+",
        default=[],
        choices=sorted({row.group for row in ROWS}),
        help="of the ablation; default all",
    )
    parser.add_argument("--seed", type=int, default=0, help="of simulated detections and intervals")
    parser.add_argument("--draws", type=int, default=2000, help="of the intervals")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--device", default="auto")
    return run_command(parser, run, arguments)


if __name__ == "__main__":
    raise SystemExit(main())
