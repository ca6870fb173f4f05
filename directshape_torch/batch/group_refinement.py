"""This module reads a group of frames, refines it and writes its files, in the same way in every process."""

from __future__ import annotations

import errno
import gc
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import torch

from directshape_torch.batch.frame_groups import FrameGroup
from directshape_torch.batch.frame_outputs import write_failure, write_frame_outputs
from directshape_torch.batch.options import RefineOptions
from directshape_torch.batch.run_summary import RunTimings, peak_device_memory_mb, peak_memory_mb
from directshape_torch.errors import CompilationError, DirectShapeError, MissingDependencyError
from directshape_torch.io.frame_collation import collate, split_by_rig
from directshape_torch.io.run_folder import FrameEntry, done_entry
from directshape_torch.io.run_manifest import hash_files
from directshape_torch.io.stereo_dataset import LoadedFrame, StereoDataset
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.refiner import DirectShapeRefiner


class OutputLostError(DirectShapeError):
    """No more results can be written to the output folder."""


# These errors affect every frame, so further frames would only fail too.
STOPS_THE_RUN = (CompilationError, MissingDependencyError, OutputLostError)
_DISK_IS_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)


@dataclass(frozen=True)
class RunJob:
    """A `RunJob` has everything that a process needs for its part of a run."""

    dataset: StereoDataset
    refiner: DirectShapeRefiner
    out_dir: Path
    options: RefineOptions  # kinds of outputs
    # Hashes of the manifest and of the shape prior.
    run: str
    prior_sha256: str


@dataclass
class GroupReport:
    """A `GroupReport` says how the frames of a group ended."""

    ends: dict[str, FrameEntry]  # in the order in which frames ended
    timings: RunTimings = field(default_factory=RunTimings)  # times of the calls, and resources of this process so far
    num_halved: int = 0  # calls that failed and were repeated with half of the frames


# A loaded frame comes with the hashes of its files.
_Ready = tuple[LoadedFrame, dict[str, str]]


def refine_group(job: RunJob, group: FrameGroup) -> GroupReport:
    """Refine the frames of a group that have no files yet, in this process; errors of a frame go to `ends`.

    Raises:
        DirectShapeError: no other frame could be refined either.
    """
    cpu_start_s = time.process_time()
    found = {name: done_entry(job.out_dir, name, job.run, job.options.outputs) for name in sorted(group.wanted)}
    ends = {name: entry for name, entry in found.items() if entry is not None}
    step = _GroupStep(job, group.without(ends))
    step.refine(group.frame_ids)
    # Frames that were finished before stay in the call, for the sake of the bytes of the others.
    step.report.ends |= ends
    timings = step.report.timings
    timings.cpu_s = time.process_time() - cpu_start_s
    timings.peak_mb, timings.peak_device_mb = peak_memory_mb(), peak_device_memory_mb(timings.device)
    return step.report


class _GroupStep:
    """A `_GroupStep` is the refinement of one group."""

    def __init__(self, job: RunJob, group: FrameGroup) -> None:
        self.job, self.group = job, group
        self.report = GroupReport({}, RunTimings(job.refiner.prior.origin.device))

    def refine(self, frame_ids: Sequence[str]) -> None:
        """Refine frames together, or in halves after a failure, down to the single frame that is the cause."""
        frame_ids = [frame_id for frame_id in frame_ids if frame_id not in self.report.ends]
        if self.group.wanted.isdisjoint(frame_ids):
            return
        problem = self._attempt(frame_ids)
        if problem is None:
            return
        # Memory is freed only here, because the traceback holds the tensors of the call until then.
        gc.collect()
        torch.cuda.empty_cache()
        if len(frame_ids) == 1:
            self._fail(frame_ids[0], problem)
            return
        self.report.num_halved += 1
        for half in FrameGroup(tuple(frame_ids), self.group.wanted.intersection(frame_ids)).halves():
            self.refine(half.frame_ids)

    def _attempt(self, frame_ids: Sequence[str]) -> str | None:
        """Refine frames together; return why they cannot be, or None if each of them has ended."""
        try:
            batch = [ready for ready in map(self._read, frame_ids) if ready is not None]
            parts = [[batch[k] for k in part] for part in split_by_rig([loaded for loaded, _ in batch])]
            results = [self._call([loaded for loaded, _ in part]) for part in parts]
        except STOPS_THE_RUN:
            raise
        # Any error of one frame among many is reported, and the other frames go on.
        except Exception as error:
            return _with_memory_advice(error, len(frame_ids))
        for part, result in zip(parts, results, strict=True):
            first_row = 0
            for loaded, inputs in part:
                end_row = first_row + len(loaded.detections)
                if loaded.frame_id in self.group.wanted:
                    self._write(loaded, inputs, result[first_row:end_row])
                first_row = end_row
        return None

    def _read(self, frame_id: str) -> _Ready | None:
        try:
            inputs = hash_files(self.job.dataset.input_files(frame_id))
            return self.job.dataset.load(frame_id), inputs
        except STOPS_THE_RUN:
            raise
        except (DirectShapeError, OSError) as error:
            self._fail(frame_id, _reason(error))
            return None

    def _call(self, batch: Sequence[LoadedFrame]) -> RefinementResult:
        prior = self.job.refiner.prior.origin
        frames, detections = collate(batch)
        frames, detections = frames.to(prior.device, prior.dtype), detections.to(prior.device, prior.dtype)
        with self.report.timings.measure(frames.frame_ids, len(detections)):
            result: RefinementResult = self.job.refiner(frames, detections)
        return result

    def _write(self, loaded: LoadedFrame, inputs: dict[str, str], result: RefinementResult) -> None:
        job = self.job
        try:
            with _writing_to(job.out_dir):
                entry = write_frame_outputs(job.out_dir, loaded, result, job.run, job.prior_sha256, inputs, job.options)
            self.report.ends[loaded.frame_id] = entry
        except STOPS_THE_RUN:
            raise
        except (DirectShapeError, OSError) as error:
            self._fail(loaded.frame_id, _reason(error))

    def _fail(self, frame_id: str, reason: str) -> None:
        # A frame that was finished before and only joined the group again stays finished.
        if frame_id in self.group.wanted:
            with _writing_to(self.job.out_dir):
                self.report.ends[frame_id] = write_failure(self.job.out_dir, frame_id, reason)


@contextmanager
def _writing_to(out_dir: Path) -> Iterator[None]:
    """Raise `OutputLostError` if the disk is full while the body runs."""
    try:
        yield
    except OSError as error:
        if error.errno not in _DISK_IS_FULL:
            raise
        raise OutputLostError(
            f"cannot write to {out_dir} any more ({error.strerror or error}): make room there and run the same command "
            "again; what is finished stays finished"
        ) from error


def set_threads(threads: int | None) -> None:
    """Set the number of threads of PyTorch and OpenCV in this process; None leaves it unchanged."""
    import cv2

    if threads is not None:
        torch.set_num_threads(threads)
        cv2.setNumThreads(threads)


@contextmanager
def limited_threads(threads: int | None) -> Iterator[None]:
    """Set the number of threads of PyTorch and OpenCV while the body runs; None leaves it unchanged."""
    import cv2

    before = torch.get_num_threads(), cv2.getNumThreads()
    set_threads(threads)
    try:
        yield
    finally:
        if threads is not None:
            torch.set_num_threads(before[0])
            cv2.setNumThreads(before[1])


def _reason(error: Exception) -> str:
    text = " ".join(str(error).split())
    return text if isinstance(error, (DirectShapeError, OSError)) and text else f"{type(error).__name__}: {text}"


def _with_memory_advice(error: Exception, num_frames: int) -> str:
    # On the CPU, PyTorch and OpenCV have no exception class for lack of memory.
    signs = ("can't allocate memory", "Insufficient memory", "CUDA out of memory")
    if not isinstance(error, (MemoryError, torch.OutOfMemoryError)) and not any(sign in str(error) for sign in signs):
        return _reason(error)
    what = "1 frame" if num_frames == 1 else f"{num_frames} frames"
    return f"too little memory for {what} in a call ({_reason(error)[:200]})"
