"""This program runs slow workers for a test that kills it: slow_run.py ROOT OUT [NUMBER OF WORKERS | RAY]."""

from __future__ import annotations

import signal
import sys
from pathlib import Path

from directshape_torch.batch.options import RefineOptions
from directshape_torch.batch.refine_dataset import refine_dataset
from directshape_torch.io.stereo_dataset import open_dataset
from helpers.quick_runs import SlowRefiner


def main(root: Path, out_dir: Path, engine: str = "2") -> None:
    dataset = open_dataset("kitti", root, root / "detections", root / "masks")
    options = RefineOptions(workers=int(engine)) if engine.isdecimal() else RefineOptions(ray=engine)
    refine_dataset(dataset, SlowRefiner(root), out_dir, options)


if __name__ == "__main__":
    # A shell that starts tests in the background lets them ignore it.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    main(Path(sys.argv[1]), Path(sys.argv[2]), *sys.argv[3:])
