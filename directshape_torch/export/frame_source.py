"""What the exports of one frame are made of, and what an exporter is."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.export.painted_cars import PaintedFrame
from directshape_torch.io.run_folder import result_path
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.visualize.run_frames import RunFrame, RunInputs


@dataclass(frozen=True)
class ExportOptions:
    """What is chosen of an export."""

    data_root: Path | None = None  # folder that names of images begin in, where a file lists them
    # Repeats the refinement, for the iterations in a recording; then the detections must be the run's.
    refiner: DirectShapeRefiner | None = None
    mirror: bool = True  # colour what the image does not show by the other side of the car
    points_per_car: int = 10_000  # points spread over a surface

    def __post_init__(self) -> None:
        if self.points_per_car < 1:
            raise InputError("points_per_car", "at least 1", str(self.points_per_car))


class FrameSource(RunFrame):
    """One finished frame of a run for all of its exporters."""

    def __init__(self, inputs: RunInputs, frame_id: str, options: ExportOptions) -> None:
        super().__init__(inputs, frame_id)
        self.options = options

    @cached_property
    def images(self) -> LoadedFrame | None:
        """Images, calibration and masks, or None where no data set was given.

        Raises:
            DataFormatError: they are not those of the run.
        """
        if self.loaded is None and self.inputs.dataset is not None:
            problems = ", ".join(sorted(self.inputs.problems))
            raise DataFormatError(result_path(self.inputs.run.path, self.frame_id), f"cannot be exported: {problems}")
        return self.loaded

    @property
    def with_images(self) -> LoadedFrame:
        """The same, for an exporter that asked for a data set."""
        assert self.images is not None, "no data set"
        return self.images

    @cached_property
    def painted(self) -> PaintedFrame:
        """Surfaces with colours.

        Raises:
            InputError: the shapes of the run were not given.
        """
        if self.inputs.prior is None:
            raise InputError("--prior", "the shape prior of the run", "nothing")
        return PaintedFrame(self.result, self.inputs.prior, self.images, self.options.mirror)


class Exporter:
    """Writes a run in one format, below a folder.

    Raises:
        InputError: what needs images has no data set.
    """

    needs_images_for = ""  # what the images are for, where it cannot do without

    def __init__(self, folder: Path, inputs: RunInputs, options: ExportOptions) -> None:
        if self.needs_images_for and inputs.dataset is None:
            raise InputError("--data", f"the data set of the run, for {self.needs_images_for}", "nothing")
        self.folder, self.inputs, self.options = folder, inputs, options

    def add(self, source: FrameSource) -> None:
        """Take the next frame."""
        raise NotImplementedError

    def finish(self) -> None:
        """Write what can only be written at the end."""

    def abandon(self) -> None:
        """A frame failed, or another exporter's end: leave nothing half-written behind."""
