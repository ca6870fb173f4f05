"""`directshape refine --rerun FILE.rrd`: a recording of the run for Rerun's viewer."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from directshape_torch.errors import InputError

if TYPE_CHECKING:
    from directshape_torch.io.stereo_dataset import StereoDataset
    from directshape_torch.refiner import DirectShapeRefiner


def check_rerun(path: Path | None) -> None:
    """Find out before the work is done that the recording could not be written.

    Raises:
        MissingDependencyError: Rerun is not installed.
        InputError: the name is not one that the viewer opens.
    """
    from directshape_torch.export.rerun_stream import import_rerun

    if path is None:
        return
    if path.suffix != ".rrd":
        raise InputError("--rerun", "a file name that ends in .rrd", str(path))
    import_rerun()


def write_recording(path: Path, out_dir: Path, dataset: StereoDataset, refiner: DirectShapeRefiner) -> None:
    """Record the frames of a data set that a run has finished, and refine them again for their iterations.

    Raises:
        DirectShapeError: a file is missing or damaged.
    """
    from directshape_torch.cli.progress import ProgressBar
    from directshape_torch.export.frame_source import ExportInputs
    from directshape_torch.export.rerun_recording import record_run
    from directshape_torch.io.run_folder import RunFolder

    done = [frame_id for frame_id in RunFolder(out_dir).frame_ids if frame_id in dataset.frame_ids]
    if not done:
        print("warning: no recording, for no frame was refined", file=sys.stderr)
        return
    with ProgressBar("record") as progress:
        inputs = ExportInputs(refiner.prior, dataset, has_detections=True, refiner=refiner)
        record_run(path, RunFolder(out_dir, done), inputs, progress)
    print(f"viewer   rerun {path}")
