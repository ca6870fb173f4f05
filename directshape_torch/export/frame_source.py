"""What the exports of one frame are made of, read or made when the first of them asks."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from directshape_torch.errors import InputError
from directshape_torch.export.painted_cars import PaintedFrame
from directshape_torch.io.run_folder import FrameResult, RunFolder
from directshape_torch.io.stereo_dataset import LoadedFrame, StereoDataset
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.shape.shape_prior import ShapePrior


@dataclass(frozen=True)
class ExportInputs:
    """What an export may use beside the run itself."""

    prior: ShapePrior | None = None  # the shapes of the run; None: exports without surfaces
    # Images, calibrations, masks and detections of the run's frames; None: exports without colours, and none that need
    # an image.
    dataset: StereoDataset | None = None
    data_root: Path | None = None  # folder that names of images begin in, where a file lists them
    # Whether the detections of that data set are those of the run; else its results stand for them.
    has_detections: bool = False
    # Repeats the refinement, for the iterations in a recording; then the detections must be the run's.
    refiner: DirectShapeRefiner | None = None
    mirror: bool = True  # colour what the image does not show by the other side of the car
    points_per_car: int = 10_000  # points spread over a surface

    def __post_init__(self) -> None:
        if self.points_per_car < 1:
            raise InputError("points_per_car", "at least 1", str(self.points_per_car))
        if self.refiner is not None and not self.has_detections:
            raise InputError("detections", "those of the run, to refine its frames again", "none")


class FrameSource:
    """One finished frame of a run."""

    def __init__(self, run: RunFolder, frame_id: str, inputs: ExportInputs) -> None:
        self.run, self.frame_id, self.inputs = run, frame_id, inputs

    @cached_property
    def refined(self) -> FrameResult:
        """Boxes, states and shapes."""
        return self.run.read(self.frame_id)

    @cached_property
    def loaded(self) -> LoadedFrame | None:
        """Images, calibration and masks, or None where no data set was given."""
        return None if self.inputs.dataset is None else self.inputs.dataset.load(self.frame_id)

    @property
    def with_images(self) -> LoadedFrame:
        """The same, for an exporter that asked for a data set."""
        assert self.loaded is not None, "no data set"
        return self.loaded

    @cached_property
    def painted(self) -> PaintedFrame:
        """Surfaces with colours.

        Raises:
            InputError: the shapes of the run were not given.
        """
        if self.inputs.prior is None:
            raise InputError("--prior", "the shape prior of the run", "nothing")
        return PaintedFrame(self.refined, self.inputs.prior, self.loaded, self.inputs.mirror)


class Exporter:
    """Writes a run in one format, below a folder.

    Raises:
        InputError: what needs images has no data set.
    """

    needs_images_for = ""  # what the images are for, where it cannot do without

    def __init__(self, folder: Path, run: RunFolder, inputs: ExportInputs) -> None:
        if self.needs_images_for and inputs.dataset is None:
            raise InputError("--data", f"the data set of the run, for {self.needs_images_for}", "nothing")
        self.folder, self.run, self.inputs = folder, run, inputs

    def add(self, source: FrameSource) -> None:
        """Take the next frame."""
        raise NotImplementedError

    def finish(self) -> None:
        """Write what can only be written at the end."""

    def abandon(self) -> None:
        """A frame failed, or another exporter's end: leave nothing half-written behind."""
