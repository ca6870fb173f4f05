"""A run as a Rerun recording: frames on one timeline, the iterations of their refinements on another."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from directshape_torch.batch.options import RunObserver
from directshape_torch.export.coco3d_file import image_numbers
from directshape_torch.export.exporters import feed
from directshape_torch.export.frame_source import ExportInputs, FrameSource
from directshape_torch.export.rerun_iterations import IterationLog
from directshape_torch.export.rerun_scene import clear_cars, log_conventions, log_frame, log_painted_cars
from directshape_torch.export.rerun_stream import RerunStream
from directshape_torch.export.run_folder import RunFolder
from directshape_torch.refinement_trace import RefinementTrace, trace_refinement
from directshape_torch.refiner import DirectShapeRefiner


class RerunExporter:
    """All frames in one recording.

    Args:
        path: of the .rrd file.
        run: the frames that will come.
        with_iterations: whether frames will come with a refiner.

    Raises:
        MissingDependencyError: Rerun is not installed.
    """

    def __init__(self, path: Path, run: RunFolder, with_iterations: bool) -> None:
        self.numbers: Mapping[str, int] = image_numbers(run.frame_ids)
        self.stream = RerunStream(path, with_iterations)
        self.iteration = 0
        log_conventions(self.stream)

    def add(self, source: FrameSource) -> None:
        """Log a frame; with a refiner also the states that it goes through when it refines the frame again.

        Raises:
            InputError: the frame has no images.
        """
        frame = self.numbers[source.frame_id]
        refiner = source.inputs.refiner
        self.stream.at(frame, None if refiner is None else self.iteration)
        log_frame(self.stream, source, source.inputs.has_detections)
        self.stream.at(frame)
        clear_cars(self.stream)
        log_painted_cars(self.stream, source.painted)
        if refiner is not None:
            self._add_iterations(source, refiner, frame)

    def finish(self) -> None:
        """Move the file to its place."""
        self.stream.close()

    def abandon(self) -> None:
        """Leave no file behind."""
        self.stream.abandon()

    def _add_iterations(self, source: FrameSource, refiner: DirectShapeRefiner, frame: int) -> None:
        loaded = source.with_images("the refinement of its frames")
        trace = _trace(source, refiner)
        log = IterationLog(self.stream, loaded, trace)
        self.stream.at(iteration=self.iteration)
        clear_cars(self.stream)
        for number in range(len(trace)):
            self.stream.at(iteration=self.iteration + number)
            log.log_state(number)
        self.stream.at(frame)
        for car in log.cars:
            log.log_residuals(car, len(trace) - 1)
        self.iteration += len(trace)


def record_run(path: Path | str, run: RunFolder, inputs: ExportInputs, observer: RunObserver | None = None) -> None:
    """Write a Rerun recording of a run, and of its iterations where `inputs` have a refiner.

    Raises:
        MissingDependencyError: Rerun is not installed.
        InputError: no images.
        DataFormatError: a file of the run or of the data set is missing or damaged.
    """
    exporter = RerunExporter(Path(path), run, inputs.refiner is not None)
    feed([exporter], run, inputs, observer)


def _trace(source: FrameSource, refiner: DirectShapeRefiner) -> RefinementTrace:
    loaded = source.with_images("the refinement of its frames")
    device, dtype = refiner.prior.origin.device, refiner.prior.origin.dtype
    return trace_refinement(refiner, loaded.frame.to(device, dtype), loaded.detections.to(device, dtype))
