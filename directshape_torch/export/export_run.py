"""`export_run`: a finished run in the formats of other programs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Literal, get_args

from directshape_torch.batch.content_hashes import hash_prior
from directshape_torch.batch.options import RunObserver
from directshape_torch.errors import InputError
from directshape_torch.export.coco3d_file import Coco3dDataset, image_numbers
from directshape_torch.export.frame_source import Exporter, ExportInputs, FrameSource
from directshape_torch.export.gltf_scene import GlbExporter
from directshape_torch.export.kitti_files import kitti_json
from directshape_torch.export.nuscenes_file import nuscenes_results
from directshape_torch.export.ply_files import mesh_ply, points_ply
from directshape_torch.export.rerun_recording import RerunExporter
from directshape_torch.export.stereo_points import stereo_points
from directshape_torch.files.atomic_files import write_bytes, write_json
from directshape_torch.files.read_files import read_bytes
from directshape_torch.io.run_folder import FrameResult, RunFolder, result_path

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


def _make(name: str, folder: Path, run: RunFolder, inputs: ExportInputs) -> Exporter:
    framewise = {"ply": _write_ply, "points": _write_points, "kitti": _write_kitti}
    if name in framewise:
        return _Framewise(folder, framewise[name])
    if name == "glb":
        return GlbExporter(folder / "glb")
    if name == "coco3d":
        return _Coco3d(folder / "coco3d.json", run)
    if name == "nuscenes":
        return _Nuscenes(folder / "nuscenes.json")
    if name == "rerun":
        return RerunExporter(folder / "recording.rrd", run, inputs.refiner is not None)
    raise InputError("formats", f"of {', '.join(get_args(ExportFormat))}", repr(name))


class _Framewise(Exporter):
    """A format with files of each frame's own."""

    def __init__(self, folder: Path, write: Callable[[Path, FrameSource], None]) -> None:
        self.folder, self.write = folder, write

    def add(self, source: FrameSource) -> None:
        self.write(self.folder, source)


class _Coco3d(Exporter):
    """All frames in one file."""

    def __init__(self, path: Path, run: RunFolder) -> None:
        self.path, self.image_ids, self.dataset = path, image_numbers(run.frame_ids), Coco3dDataset()

    def add(self, source: FrameSource) -> None:
        loaded = source.with_images("the sizes and intrinsics that coco3d lists")
        self.dataset.add(source.refined, loaded, self.image_ids[source.frame_id], source.image_path())

    def finish(self) -> None:
        write_json(self.path, self.dataset.content)


class _Nuscenes(Exporter):
    """All frames in one file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.frames: list[FrameResult] = []

    def add(self, source: FrameSource) -> None:
        self.frames.append(source.refined)

    def finish(self) -> None:
        write_json(self.path, nuscenes_results(self.frames))


def _write_ply(folder: Path, source: FrameSource) -> None:
    """`ply/NNNNNN_LINE.ply`: the surface of each refined car."""
    for index, one in enumerate(source.painted.objects):
        mesh, paint = source.painted.mesh(index)
        write_bytes(folder / "ply" / f"{source.frame_id}_{one.line.line_number}.ply", mesh_ply(mesh, paint))


def _write_points(folder: Path, source: FrameSource) -> None:
    """`points/NNNNNN_LINE.ply` of each refined car, and beside it `.._stereo.ply` where stereo saw any."""
    painted = source.painted
    measured = {} if source.loaded is None or painted.view is None else stereo_points(source.loaded, painted.view)
    for index, one in enumerate(painted.objects):
        stem = folder / "points" / f"{source.frame_id}_{one.line.line_number}"
        samples = painted.samples(index, source.inputs.points_per_car)
        paint = samples.paint
        write_bytes(f"{stem}.ply", points_ply(samples.points_cam, paint.rgb, samples.normals_cam, paint.source))
        stereo = measured.get(one.line.line_number)
        if stereo is not None and len(stereo.points_cam):
            write_bytes(f"{stem}_stereo.ply", points_ply(stereo.points_cam, stereo.rgb))


def _write_kitti(folder: Path, source: FrameSource) -> None:
    """`kitti/data/NNNNNN.txt`, the result file byte for byte, and `kitti/json/NNNNNN.json`."""
    text = read_bytes(result_path(source.run.path, source.frame_id))
    write_bytes(folder / "kitti" / "data" / f"{source.frame_id}.txt", text)
    write_json(folder / "kitti" / "json" / f"{source.frame_id}.json", kitti_json(source.refined))
