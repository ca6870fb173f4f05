"""A run as a Rerun recording: frames on one timeline, the iterations of their refinements on another."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from directshape_torch.export.coco3d_file import image_numbers
from directshape_torch.export.frame_source import Exporter, FrameSource
from directshape_torch.export.rerun_iterations import IterationLog
from directshape_torch.export.rerun_scene import clear_cars, log_conventions, log_frame, log_painted_cars
from directshape_torch.export.rerun_stream import RerunStream, import_rerun
from directshape_torch.io.run_folder import RunFolder
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.visualize.inspection.residual_figure import car_residuals
from directshape_torch.visualize.refinement_trace import RefinementTrace, trace_refinement


class RerunExporter(Exporter):
    """All frames in one recording.

    Args:
        path: of the .rrd file.
        run: the frames that will come.
        with_iterations: whether frames will come with a refiner.

    Raises:
        MissingDependencyError: Rerun is not installed.
    """

    def __init__(self, path: Path, run: RunFolder, with_iterations: bool) -> None:
        import_rerun()
        self.path, self.with_iterations = path, with_iterations
        self.numbers: Mapping[str, int] = image_numbers(run.frame_ids)
        self.iteration = 0
        self._stream: RerunStream | None = None

    def add(self, source: FrameSource) -> None:
        """Log a frame; with a refiner also the states that it goes through when it refines the frame again.

        Raises:
            InputError: the frame has no images.
        """
        stream, frame = self._begun(source), self.numbers[source.frame_id]
        refiner = source.inputs.refiner
        stream.at(frame, None if refiner is None else self.iteration)
        log_frame(stream, source, source.inputs.has_detections)
        stream.at(frame)
        clear_cars(stream)
        log_painted_cars(stream, source.painted)
        if refiner is not None:
            self._add_iterations(stream, source, refiner, frame)

    def finish(self) -> None:
        """Move the file to its place."""
        if self._stream is not None:
            self._stream.close()
            # What is in its place is not for `abandon`.
            self._stream = None

    def abandon(self) -> None:
        """Leave no file behind."""
        if self._stream is not None:
            self._stream.abandon()

    def _begun(self, source: FrameSource) -> RerunStream:
        """The recording, begun with the first frame: its images say what the viewer's views are fitted to."""
        if self._stream is None:
            height, width = source.with_images("the pictures of a recording").frame.sizes[0].tolist()
            self._stream = RerunStream(self.path, (width, height), self.with_iterations)
            log_conventions(self._stream)
        return self._stream

    def _add_iterations(
        self, stream: RerunStream, source: FrameSource, refiner: DirectShapeRefiner, frame: int
    ) -> None:
        loaded = source.with_images("the refinement of its frames")
        trace = _trace(source, refiner)
        log = IterationLog(stream, loaded, trace)
        stream.at(iteration=self.iteration)
        clear_cars(stream)
        for number in range(len(trace)):
            stream.at(iteration=self.iteration + number)
            log.log_state(number)
        stream.at(frame)
        residuals = car_residuals(trace, len(trace) - 1)
        for car in log.cars:
            log.log_residuals(car, residuals[car])
        self.iteration += len(trace)


def _trace(source: FrameSource, refiner: DirectShapeRefiner) -> RefinementTrace:
    loaded = source.with_images("the refinement of its frames")
    device, dtype = refiner.prior.origin.device, refiner.prior.origin.dtype
    return trace_refinement(refiner, loaded.frame.to(device, dtype), loaded.detections.to(device, dtype))
