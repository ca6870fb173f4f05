"""`export_run`: a finished run in the formats of other programs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Literal

from directshape_torch.batch.options import RunObserver
from directshape_torch.errors import InputError
from directshape_torch.export.box_files import Coco3dExporter, NuscenesExporter, write_kitti
from directshape_torch.export.frame_source import Exporter, ExportInputs, FrameSource
from directshape_torch.export.gltf_scene import GlbExporter
from directshape_torch.export.ply_files import write_ply, write_points
from directshape_torch.export.rerun_recording import RerunExporter
from directshape_torch.io.run_folder import RunFolder
from directshape_torch.io.run_manifest import hash_prior

ExportFormat = Literal["glb", "ply", "points", "kitti", "coco3d", "nuscenes", "rerun"]
"""What `export_run` can write (docs/outputs.md)."""


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
    observer = RunObserver() if observer is None else observer
    exporters = [_make(one, Path(folder), run, inputs) for one in dict.fromkeys(formats)]
    with ExitStack() as stack:
        for exporter in exporters:
            stack.callback(exporter.abandon)
        observer.started(run.frame_ids)
        for frame_id in run.frame_ids:
            # What is read or made of a frame serves all of them.
            source = FrameSource(run, frame_id, inputs)
            for exporter in exporters:
                exporter.add(source)
            observer.finished(frame_id, None)
        for exporter in exporters:
            exporter.finish()
        stack.pop_all()


class _Framewise(Exporter):
    """A format with files of each frame's own."""

    def __init__(self, folder: Path, write: Callable[[Path, FrameSource], None]) -> None:
        self.folder, self.write = folder, write

    def add(self, source: FrameSource) -> None:
        self.write(self.folder, source)


def _make(name: str, folder: Path, run: RunFolder, inputs: ExportInputs) -> Exporter:
    makers: dict[str, Callable[[], Exporter]] = {
        "glb": lambda: GlbExporter(folder / "glb"),
        "ply": lambda: _Framewise(folder, write_ply),
        "points": lambda: _Framewise(folder, write_points),
        "kitti": lambda: _Framewise(folder, write_kitti),
        "coco3d": lambda: Coco3dExporter(folder / "coco3d.json", run),
        "nuscenes": lambda: NuscenesExporter(folder / "nuscenes.json"),
        "rerun": lambda: RerunExporter(folder / "recording.rrd", run, inputs.refiner is not None),
    }
    if name not in makers:
        raise InputError("formats", f"of {', '.join(makers)}", repr(name))
    return makers[name]()
