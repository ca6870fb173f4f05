"""`export_run` writes a finished run in the formats of other programs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path

from directshape_torch.errors import InputError
from directshape_torch.files.atomic_files import check_folder
from directshape_torch.visualize.frame_source import Exporter, ExportOptions, FrameSource
from directshape_torch.visualize.kitti_files import KittiExporter
from directshape_torch.visualize.rerun_recording import RerunExporter
from directshape_torch.visualize.run_frames import RunInputs
from directshape_torch.visualize.surface_files import GlbExporter, PlyExporter, PointsExporter

FORMATS: dict[str, type[Exporter]] = {
    "glb": GlbExporter,
    "ply": PlyExporter,
    "points": PointsExporter,
    "kitti": KittiExporter,
    "rerun": RerunExporter,
}
"""These are the formats of `export_run` (docs/outputs.md)."""


def export_run(
    inputs: RunInputs,
    folder: Path | str,
    formats: Sequence[str],
    options: ExportOptions | None = None,
    tell: Callable[[str], object] = lambda _: None,
) -> None:
    """Write the finished frames of a run in other formats (docs/outputs.md). The run itself is only read.

    Args:
        inputs: chosen frames of an output folder, shape prior, and the images for colours.
        folder: folder of `glb`, `ply`, `points`, `kitti` and `recording.rrd`; existing files with the same names are
            replaced.
        formats: names out of `FORMATS`.
        options: appearance and details.
        tell: function that is called after each frame.

    Raises:
        MissingDependencyError: "rerun" is chosen without Rerun.
        InputError: a format is unknown, or needs images which were not given.
        DataFormatError: a file of the run or of the data set is missing, damaged or not that of the run.
    """
    run, options = inputs.run, ExportOptions() if options is None else options
    check_folder("out", Path(folder))
    if not run.frame_ids:
        raise InputError("frames", f"finished frames of {run.path}", "none")
    if unknown := [name for name in formats if name not in FORMATS]:
        raise InputError("formats", f"of {', '.join(FORMATS)}", repr(unknown[0]))
    if options.refiner is not None and not inputs.has_detections:
        raise InputError("detections", "those of the run, to refine its frames again", "none")
    exporters = [FORMATS[name](Path(folder), inputs, options) for name in dict.fromkeys(formats)]
    with ExitStack() as stack:
        for exporter in exporters:
            stack.callback(exporter.abandon)
        for frame_id in run.frame_ids:
            # All exporters of a frame share what is read and computed.
            source = FrameSource(inputs, frame_id, options)
            for exporter in exporters:
                exporter.add(source)
            tell(frame_id)
        for exporter in exporters:
            exporter.finish()
        stack.pop_all()
