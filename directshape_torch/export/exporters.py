"""One exporter for each format: it is handed frame after frame, and told when there are no more."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Protocol

from directshape_torch.batch.options import RunObserver, SilentObserver
from directshape_torch.export.coco3d_file import Coco3dDataset, image_numbers
from directshape_torch.export.frame_source import ExportInputs, FrameSource
from directshape_torch.export.gltf_scene import frame_glb
from directshape_torch.export.kitti_files import kitti_json
from directshape_torch.export.nuscenes_file import nuscenes_results
from directshape_torch.export.ply_files import mesh_ply, points_ply
from directshape_torch.export.stereo_points import stereo_points
from directshape_torch.files.atomic_files import write_bytes, write_json
from directshape_torch.files.read_files import read_bytes
from directshape_torch.io.run_folder import FrameResult, RunFolder, result_path


class Exporter(Protocol):
    """Writes a run in one format."""

    def add(self, source: FrameSource) -> None:
        """Take the next frame."""
        ...

    def finish(self) -> None:
        """Write what can only be written at the end."""
        ...

    def abandon(self) -> None:
        """A frame failed, or another exporter's end: leave nothing half-written behind."""
        ...


class FramewiseExporter:
    """A format with files of each frame's own.

    Args:
        folder: gets the files.
        write: makes those of one frame.
    """

    def __init__(self, folder: Path, write: Callable[[Path, FrameSource], None]) -> None:
        self.folder, self.write = folder, write

    def add(self, source: FrameSource) -> None:
        """Write the frame's files."""
        self.write(self.folder, source)

    def finish(self) -> None:
        """Nothing."""

    def abandon(self) -> None:
        """Nothing: each file is whole."""


class Coco3dExporter:
    """All frames in one `coco3d.json`."""

    def __init__(self, folder: Path, run: RunFolder) -> None:
        self.path, self.image_ids = folder / "coco3d.json", image_numbers(run.frame_ids)
        self.dataset = Coco3dDataset()

    def add(self, source: FrameSource) -> None:
        """Collect the frame's boxes."""
        loaded = source.with_images("the sizes and intrinsics that coco3d lists")
        self.dataset.add(source.refined, loaded, self.image_ids[source.frame_id], source.image_path())

    def finish(self) -> None:
        """Write the file."""
        write_json(self.path, self.dataset.content)

    def abandon(self) -> None:
        """Nothing was written."""


class NuscenesExporter:
    """All frames in one `nuscenes.json`."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "nuscenes.json"
        self.frames: list[FrameResult] = []

    def add(self, source: FrameSource) -> None:
        """Collect the frame's boxes."""
        self.frames.append(source.refined)

    def finish(self) -> None:
        """Write the file."""
        write_json(self.path, nuscenes_results(self.frames))

    def abandon(self) -> None:
        """Nothing was written."""


def feed(
    exporters: Sequence[Exporter], run: RunFolder, inputs: ExportInputs, observer: RunObserver | None = None
) -> None:
    """Hand every frame of a run to some exporters; what is read or made of a frame serves them all.

    Raises:
        DirectShapeError: the first failure of an exporter.
    """
    observer = SilentObserver() if observer is None else observer
    with ExitStack() as stack:
        for exporter in exporters:
            stack.callback(exporter.abandon)
        observer.started(run.frame_ids)
        for frame_id in run.frame_ids:
            source = FrameSource(run, frame_id, inputs)
            for exporter in exporters:
                exporter.add(source)
            observer.finished(frame_id, None)
        for exporter in exporters:
            exporter.finish()
        stack.pop_all()


def write_glb(folder: Path, source: FrameSource) -> None:
    """`glb/NNNNNN.glb`: all refined cars of the frame."""
    write_bytes(folder / "glb" / f"{source.frame_id}.glb", frame_glb(source.painted, source.loaded))


def write_ply(folder: Path, source: FrameSource) -> None:
    """`ply/NNNNNN_LINE.ply`: the surface of each refined car."""
    for index, one in enumerate(source.painted.objects):
        mesh, paint = source.painted.mesh(index)
        write_bytes(folder / "ply" / f"{source.frame_id}_{one.line.line_number}.ply", mesh_ply(mesh, paint))


def write_points(folder: Path, source: FrameSource) -> None:
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


def write_kitti(folder: Path, source: FrameSource) -> None:
    """`kitti/data/NNNNNN.txt`, the result file byte for byte, and `kitti/json/NNNNNN.json`."""
    text = read_bytes(result_path(source.run.path, source.frame_id))
    write_bytes(folder / "kitti" / "data" / f"{source.frame_id}.txt", text)
    write_json(folder / "kitti" / "json" / f"{source.frame_id}.json", kitti_json(source.refined))
