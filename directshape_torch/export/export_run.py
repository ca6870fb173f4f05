"""`export_run`: a finished run in the formats of other programs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, get_args

from directshape_torch.batch.content_hashes import hash_prior
from directshape_torch.batch.options import RunObserver
from directshape_torch.errors import InputError
from directshape_torch.export import exporters
from directshape_torch.export.exporters import Exporter, FramewiseExporter, feed
from directshape_torch.export.frame_source import ExportInputs
from directshape_torch.export.rerun_recording import RerunExporter
from directshape_torch.io.run_folder import RunFolder

ExportFormat = Literal["glb", "ply", "points", "kitti", "coco3d", "nuscenes", "rerun"]
"""What `export_run` can write (docs/outputs.md)."""

_FRAMEWISE = {
    "glb": exporters.write_glb,
    "ply": exporters.write_ply,
    "points": exporters.write_points,
    "kitti": exporters.write_kitti,
}


def export_run(
    run: RunFolder,
    folder: Path | str,
    formats: Sequence[ExportFormat],
    inputs: ExportInputs,
    observer: RunObserver | None = None,
) -> None:
    """Write the finished frames of a run in other formats (docs/outputs.md). The run itself is only read.

    Args:
        run: which frames of which output folder.
        folder: gets `glb`, `ply`, `points`, `kitti`, `coco3d.json`, `nuscenes.json`, `recording.rrd`; files of an
            earlier export that have the same names are replaced.
        formats: which of these.
        inputs: shape priors, and the images for colours.
        observer: is told of each frame.

    Raises:
        MissingDependencyError: "rerun" without Rerun.
        InputError: an unknown format, or one that needs images which were not given.
        DataFormatError: a file of the run or of the data set is missing or damaged.
    """
    if not run.frame_ids:
        raise InputError("frames", f"finished frames of {run.path}", "none")
    if inputs.prior is not None and hash_prior(inputs.prior) != run.manifest.sha256["prior"]:
        raise InputError("prior", "that of the run", "another one", "name that of the run with --prior")
    feed([_make(one, Path(folder), run, inputs) for one in dict.fromkeys(formats)], run, inputs, observer)


def _make(name: str, folder: Path, run: RunFolder, inputs: ExportInputs) -> Exporter:
    if name in _FRAMEWISE:
        return FramewiseExporter(folder, _FRAMEWISE[name])
    if name == "coco3d":
        return exporters.Coco3dExporter(folder, run)
    if name == "nuscenes":
        return exporters.NuscenesExporter(folder)
    if name == "rerun":
        return RerunExporter(folder / "recording.rrd", run, inputs.refiner is not None)
    raise InputError("formats", f"of {', '.join(get_args(ExportFormat))}", repr(name))
