"""This module has the base class of exporters and the data of one frame that they share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.io.run_folder import result_path
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.visualize.painted_cars import PaintedFrame
from directshape_torch.visualize.run_frames import RunFrame, RunInputs


@dataclass(frozen=True)
class ExportOptions:
    """An `ExportOptions` has the choices for an export."""

    # Refiner that repeats the refinement, for the iterations in a recording; it needs the detections of the run.
    refiner: DirectShapeRefiner | None = None
    mirror: bool = True  # whether to colour unseen parts by the other side of the car
    points_per_car: int = 10_000  # points sampled on a surface

    def __post_init__(self) -> None:
        if self.points_per_car < 1:
            raise InputError("points_per_car", "at least 1", str(self.points_per_car))


class FrameSource(RunFrame):
    """A `FrameSource` is one finished frame of a run for all of its exporters."""

    def __init__(self, inputs: RunInputs, frame_id: str, options: ExportOptions) -> None:
        super().__init__(inputs, frame_id)
        self.options = options

    @cached_property
    def images(self) -> LoadedFrame | None:
        """Images, calibration and masks, or None without a data set.

        Raises:
            DataFormatError: the files are not those of the run.
        """
        if self.loaded is None and self.inputs.dataset is not None:
            problems = ", ".join(sorted(self.inputs.problems))
            raise DataFormatError(result_path(self.inputs.run.path, self.frame_id), f"cannot be exported: {problems}")
        return self.loaded

    @property
    def with_images(self) -> LoadedFrame:
        """Images, calibration and masks, for an exporter that needs them."""
        assert self.images is not None, "no data set"
        return self.images

    @cached_property
    def refined(self) -> list[int]:
        """Rows of the refined cars, which are the cars of `painted`, in the same order."""
        return [row for row, car in enumerate(self.after) if car.is_refined]

    @cached_property
    def painted(self) -> PaintedFrame:
        """Surfaces with colours.

        Raises:
            InputError: the shape prior of the run was not given.
        """
        if self.inputs.prior is None:
            raise InputError("--prior", "the shape prior of the run", "nothing")
        cars = [self.after[row] for row in self.refined]
        return PaintedFrame(cars, self.inputs.prior, self.images, self.options.mirror)


class Exporter:
    """An `Exporter` writes a run in one format into a folder."""

    def __init__(self, folder: Path, inputs: RunInputs, options: ExportOptions) -> None:
        self.folder, self.inputs, self.options = folder, inputs, options

    def add(self, source: FrameSource) -> None:
        """Add the next frame."""
        raise NotImplementedError

    def finish(self) -> None:
        """Write the parts that need all frames."""

    def abandon(self) -> None:
        """Remove unfinished files, because a frame or another exporter failed."""


def frame_numbers(frame_ids: Sequence[str]) -> dict[str, int]:
    """The numbers in the ids of frames, or 1, 2, .. if the ids are not distinct numbers.

    Examples:
        >>> frame_numbers(["000107", "007322"])
        {'000107': 107, '007322': 7322}
    """
    if all(one.isdigit() for one in frame_ids) and len({int(one) for one in frame_ids}) == len(frame_ids):
        return {one: int(one) for one in frame_ids}
    return {one: number for number, one in enumerate(frame_ids, start=1)}
