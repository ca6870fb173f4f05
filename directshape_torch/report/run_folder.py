"""The output folder of a run, read frame by frame."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from directshape_torch.batch.run_file import read_run_file
from directshape_torch.batch.run_results import finished_frames, read_run_results
from directshape_torch.batch.run_status import read_status
from directshape_torch.errors import DataFormatError
from directshape_torch.io.kitti_labels import KittiObject, read_objects
from directshape_torch.io.refinement_files import result_path, shapes_path
from directshape_torch.io.result_files import ShapeArrays, read_shapes
from directshape_torch.io.run_manifest import RunManifest


@dataclass(frozen=True)
class FrameResult:
    """What a run left of one frame.

    Attributes:
        frame_id: the frame.
        shapes: states and shapes of its cars.
        cars: the result line of each.
        mesh_files: the saved mesh of each, or None.
    """

    frame_id: str
    shapes: ShapeArrays
    cars: list[KittiObject]
    mesh_files: list[Path | None]


@dataclass(frozen=True)
class RunFolder:
    """An output folder of `directshape refine`.

    Attributes:
        out_dir: the folder.
        manifest: its `summary.json`, with the frames that its journals add.
    """

    out_dir: Path
    manifest: RunManifest

    @classmethod
    def open(cls, out_dir: Path) -> RunFolder:
        """Read what the run was made of.

        Raises:
            DataFormatError: the folder holds no `summary.json`.
        """
        return cls(out_dir, read_run_results(out_dir))

    @property
    def unfinished(self) -> str | None:
        """How the run stands and how many frames are left where it has not finished; None where it has."""
        if read_run_file(self.out_dir) is None:
            return None
        status = read_status(self.out_dir)
        return None if status.state == "finished" else f"{status.state}, {status.num_left} frames left"

    @property
    def done(self) -> list[str]:
        """Frames that were refined, in order."""
        return finished_frames(self.out_dir, self.manifest)

    @property
    def classes(self) -> tuple[str, ...]:
        """Types that were refined."""
        return tuple(self.manifest.config.get("classes", ("Car",)))

    @property
    def failed(self) -> dict[str, str]:
        """Why the other frames were not."""
        frames = sorted(self.manifest.frames.items())
        return {name: str(entry.get("reason", "")) for name, entry in frames if entry.get("state") != "done"}

    def read(self, frame_id: str) -> FrameResult:
        """The results of a frame.

        Raises:
            DataFormatError: a file is missing, damaged, or the two do not belong together.
        """
        shapes = read_shapes(shapes_path(self.out_dir, frame_id))
        path = result_path(self.out_dir, frame_id)
        cars = self.refined_lines(read_objects(path))
        if len(cars) != len(shapes.input_lines):
            problem = f"has {len(cars)} lines of the refined classes, the shapes of its frame {len(shapes.input_lines)}"
            raise DataFormatError(path, problem, cure="refine the frame again")
        return FrameResult(frame_id, shapes, cars, self._mesh_files(frame_id, shapes))

    def refined_lines(self, lines: list[KittiObject]) -> list[KittiObject]:
        """Of the lines of a detection or result file those that the run refines, in the order of its shapes."""
        return [line for line in lines if line.type in self.classes and line.has_box_3d]

    def _mesh_files(self, frame_id: str, shapes: ShapeArrays) -> list[Path | None]:
        names = self.manifest.frames[frame_id].get("mesh_files", ())
        # "meshes/NNNNNN_LINE.ply"; a frame's name may hold an underscore too.
        by_line = {int(Path(name).stem.rpartition("_")[2]): self.out_dir / name for name in names}
        files = (by_line.get(line) for line in shapes.input_lines.tolist())
        return [file if file is not None and file.is_file() else None for file in files]
