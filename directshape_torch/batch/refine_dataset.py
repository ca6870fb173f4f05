"""`refine_dataset`: every frame of a data set refined into a folder, one bad frame not stopping the others."""

from __future__ import annotations

import contextlib
import importlib.metadata
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from directshape_torch.batch.content_hashes import hash_field, hash_prior
from directshape_torch.batch.frame_outputs import failed_entry, frame_entry, write_frame_outputs
from directshape_torch.batch.options import RefineOptions, RunObserver, SilentObserver
from directshape_torch.batch.run_record import RunRecord
from directshape_torch.batch.run_summary import RunSummary, find_warnings
from directshape_torch.batch.timing import RunTimings, write_timings
from directshape_torch.compilation import cars_ahead
from directshape_torch.config_files import config_to_mapping
from directshape_torch.errors import DirectShapeError, InputError
from directshape_torch.io.frame_collation import collate
from directshape_torch.io.run_manifest import RunManifest, hash_files
from directshape_torch.io.stereo_dataset import LoadedFrame, StereoDataset
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.result import RefinementResult

# Detection files that tell how many cars are ahead.
_FRAMES_COUNTED = 50


def refine_dataset(
    dataset: StereoDataset,
    refiner: DirectShapeRefiner,
    out_dir: Path | str,
    options: RefineOptions | None = None,
    observer: RunObserver | None = None,
) -> RunSummary:
    """Refine all frames of a data set and write the results (docs/file_formats.md).

    A second call continues where the first stopped. Frames that cannot be read or refined are reported and do not stop
    the others; they are tried again by the next call.

    Args:
        dataset: the frames, in the dtype of the refiner.
        refiner: on any device.
        out_dir: gets `data`, `shapes`, `summary.json`, `timings.json` and what the options ask for.
        options: kinds of outputs and frames in a call.
        observer: is told of each frame.

    Raises:
        ResumeError: the folder holds results of another configuration, prior or input.
        InputError: the folder would overwrite the detections.
    """
    out_dir, options = Path(out_dir), options or RefineOptions()
    _check_out_dir(dataset, out_dir)
    run = _Run(dataset, refiner, out_dir, options, observer or SilentObserver())
    return run.execute()


@dataclass(frozen=True)
class _Ready:
    """A frame that was read, with the hashes of its files."""

    loaded: LoadedFrame
    inputs: dict[str, str]


class _Run:
    """One run: the things that all of its steps need."""

    def __init__(
        self,
        dataset: StereoDataset,
        refiner: DirectShapeRefiner,
        out_dir: Path,
        options: RefineOptions,
        observer: RunObserver,
    ) -> None:
        self.dataset, self.refiner, self.out_dir = dataset, refiner, out_dir
        self.options, self.observer = options, observer
        self.prior_sha256 = hash_prior(refiner.prior)
        self.record = RunRecord(out_dir, run_manifest(dataset, refiner, self.prior_sha256))
        self.timings = RunTimings(refiner.prior.origin.device)

    def execute(self) -> RunSummary:
        resumed = self.record.finished_frames(self.dataset, self.options.outputs)
        todo = [frame_id for frame_id in self.dataset.frame_ids if frame_id not in set(resumed)]
        self.observer.started(todo)
        try:
            with cars_ahead(expected_cars(self.dataset, todo)):
                for batch in _batches(todo, self.options.batch_frames):
                    self._refine([ready for ready in map(self._read, batch) if ready is not None])
        finally:
            # Also when the user interrupts: what is finished need not be done again.
            self.record.write()
            if self.timings.calls:
                write_timings(self.out_dir / "timings.json", self.timings)
        return self._summary(resumed)

    def _read(self, frame_id: str) -> _Ready | None:
        try:
            inputs = hash_files(self.dataset.input_files(frame_id))
            return _Ready(self.dataset.load(frame_id), inputs)
        except (DirectShapeError, OSError) as error:
            self._fail(frame_id, error)
            return None

    def _refine(self, batch: Sequence[_Ready]) -> None:
        if not batch:
            return
        prior = self.refiner.prior.origin
        frames, detections = collate([ready.loaded for ready in batch])
        frames, detections = frames.to(prior.device, prior.dtype), detections.to(prior.device, prior.dtype)
        try:
            with self.timings.measure(frames.frame_ids, len(detections)):
                result = self.refiner(frames, detections)
        except torch.OutOfMemoryError as error:
            size = f"{len(batch)} frames with {len(detections)} cars"
            raise DirectShapeError(f"the device has too little memory for {size}; lower batch_frames") from error
        first_row = 0
        for ready in batch:
            self._write(ready, result, first_row)
            first_row += len(ready.loaded.detections)

    def _write(self, ready: _Ready, result: RefinementResult, first_row: int) -> None:
        loaded = ready.loaded
        try:
            write_frame_outputs(self.out_dir, loaded, result, first_row, self.prior_sha256, self.options)
        except (DirectShapeError, OSError) as error:
            self._fail(loaded.frame_id, error)
            return
        self.record.add(loaded.frame_id, ready.inputs, frame_entry(loaded, result, first_row, self.options))
        self.observer.finished(loaded.frame_id, None)

    def _fail(self, frame_id: str, error: Exception) -> None:
        reason = " ".join(str(error).split())
        self.record.add(frame_id, {}, failed_entry(reason))
        self.observer.finished(frame_id, reason)

    def _summary(self, resumed: Sequence[str]) -> RunSummary:
        entries = self.record.manifest.frames
        frames = {frame_id: entries[frame_id] for frame_id in self.dataset.frame_ids}
        failed = {frame_id: entry["reason"] for frame_id, entry in frames.items() if entry["state"] == "failed"}
        warnings = find_warnings(frames, sorted(self.dataset.classes))
        return RunSummary(frames, tuple(resumed), failed, warnings, self.timings)


def expected_cars(dataset: StereoDataset, frame_ids: Sequence[str]) -> int:
    """About how many cars frames have, from the detection files of some of them: whether compiling will pay."""
    looked_at = frame_ids[:: max(1, len(frame_ids) // _FRAMES_COUNTED)]
    count = 0
    for frame_id in looked_at:
        # A file that cannot be read is reported when its turn comes.
        with contextlib.suppress(DirectShapeError, OSError):
            objects = dataset.objects(frame_id)
            count += sum(found.type in dataset.classes for found in objects)
    return round(count * len(frame_ids) / max(1, len(looked_at)))


def run_manifest(dataset: StereoDataset, refiner: DirectShapeRefiner, prior_sha256: str) -> RunManifest:
    """What the results of a run depend on, besides the files of each frame.

    Device, batch size and kinds of outputs are left out: they do not change what is computed.
    """
    settings = {
        "refiner": config_to_mapping(refiner.config),
        "classes": sorted(dataset.classes),
        "ground": dataset.ground,
        "camera_height_m": dataset.camera_height_m,
        "dtype": str(refiner.prior.origin.dtype).removeprefix("torch."),
    }
    hashes = {"prior": prior_sha256, "stereo_bias": hash_field(dataset.disparity_field)}
    return RunManifest(package_version(), settings, hashes)


def package_version() -> str:
    """The installed version, or "not installed" for a source tree on the import path."""
    try:
        return importlib.metadata.version("directshape_torch")
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def _check_out_dir(dataset: StereoDataset, out_dir: Path) -> None:
    written = (out_dir / "data").resolve()
    for read in (dataset.detections_dir, dataset.detections_dir / "data"):
        if written == read.resolve():
            raise InputError(
                "out", "a folder other than that of the detections", str(out_dir), "it would overwrite its own input"
            )


def _batches(items: Sequence[str], size: int) -> Iterator[Sequence[str]]:
    return (items[first : first + size] for first in range(0, len(items), size))
