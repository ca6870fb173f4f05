"""`refine_dataset` refines every frame of a data set into a folder; a frame that fails does not stop the others."""

from __future__ import annotations

import contextlib
import importlib.metadata
import time
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

from directshape_torch.batch.engines import Engine, LocalEngine, reports_of
from directshape_torch.batch.frame_groups import FrameGroup, frame_groups, track_windows
from directshape_torch.batch.frame_outputs import write_failure
from directshape_torch.batch.group_refinement import GroupReport, RunJob, limited_threads, refine_group
from directshape_torch.batch.options import RefineOptions, RunObserver
from directshape_torch.batch.ray_engine import RayEngine
from directshape_torch.batch.resumption import (
    OUTPUT_FOLDERS,
    check_folder_of,
    finished_frames,
    forget_failures,
    join_summary,
    remove_results,
    remove_stale_files,
)
from directshape_torch.batch.run_summary import RunSummary, RunTimings, digit_warnings, find_warnings, write_timings
from directshape_torch.errors import InputError
from directshape_torch.files.atomic_files import check_folder
from directshape_torch.io.config_files import config_to_mapping
from directshape_torch.io.result_files import read_shapes
from directshape_torch.io.run_folder import FrameEntry, overlay_path, result_path, shapes_path
from directshape_torch.io.run_manifest import RunManifest, SharedHashes, hash_fields, hash_prior
from directshape_torch.io.stereo_dataset import StereoDataset
from directshape_torch.refinement.scene_problem import TermFactory
from directshape_torch.refiner import DirectShapeRefiner


def refine_dataset(
    dataset: StereoDataset,
    refiner: DirectShapeRefiner,
    out_dir: Path | str,
    options: RefineOptions | None = None,
    observer: RunObserver | None = None,
    *,
    fresh: bool = False,
) -> RunSummary:
    """Refine all frames of a data set and write the results (docs/file_formats.md, docs/run_on_everything.md).

    A second call continues an interrupted first call. Frames that cannot be read or refined are reported and do not
    stop the others; the next call tries them again. With the same number of threads and of frames in a call, results
    are the same byte for byte in all processes.

    Args:
        dataset: the frames, in the dtype of the refiner.
        refiner: refiner on any device.
        out_dir: folder of `data`, `shapes`, `summary.json`, `timings.json` and the files that the options ask for.
        options: kinds of outputs, frames in a call, number of processes. Default: this process only.
        observer: observer that is told of each frame.
        fresh: whether to remove files of earlier runs and start again.

    Raises:
        ResumeError: the folder has results of another configuration, prior or input.
        InputError: `out_dir` is not a folder or would overwrite the detections, a folder in it is a link, or a cluster
            of Ray cannot do the job.
        DirectShapeError: the run cannot continue, because the disk is full or workers die before they finish a frame.
    """
    out_dir, options = Path(out_dir), options or RefineOptions()
    check_out_dir(dataset, out_dir)
    manifest = run_manifest(dataset, refiner, options.batch_frames)
    job = RunJob(dataset, refiner, out_dir, options, manifest.hash, manifest.sha256["prior"])
    with contextlib.ExitStack() as stack:
        engine: Engine | None = None
        if options.ray is not None:
            engine = stack.enter_context(RayEngine(job, options.ray))
        elif options.workers is not None:
            engine = stack.enter_context(LocalEngine(job, options.workers))
        else:
            stack.enter_context(limited_threads(options.threads))
        remove_stale_files(out_dir)
        is_cleared = fresh and remove_results(out_dir)
        check_folder_of(out_dir, manifest, is_cleared)
        return _Run(job, engine, observer or RunObserver()).execute(manifest)


class _Run:
    """A `_Run` is one run in the process that the user started."""

    def __init__(self, job: RunJob, engine: Engine | None, observer: RunObserver) -> None:
        self.job, self.engine, self.observer = job, engine, observer
        self.dataset, self.options, self.out_dir = job.dataset, job.options, job.out_dir
        self.ends: dict[str, FrameEntry] = {}
        self.timings = RunTimings(job.refiner.prior.origin.device, batch_frames=job.options.batch_frames)
        if engine is not None:
            self.timings.threads, self.timings.workers = job.options.threads_per_worker or 1, engine.workers
        self.warnings: list[str] = []
        self.num_halved = 0

    def execute(self, manifest: RunManifest) -> RunSummary:
        resumed, damaged = finished_frames(self.out_dir, self.dataset, self.job.run, self.options.outputs)
        self.ends.update(resumed)
        if damaged:
            found = f"files of {len(damaged)} finished frames were damaged or gone and made again"
            self.warnings.append(f"{found}: {_some(damaged)}")
        groups = self._groups(resumed)
        if groups and resumed:
            self.warnings += digit_warnings(self.out_dir, self.timings)
        wanted = [name for group in groups for name in group.frame_ids if name in group.wanted]
        self.observer.started(wanted)
        join_summary(self.out_dir, manifest)
        if groups:
            forget_failures(self.out_dir, wanted)
            write_timings(self.out_dir, self.timings)
            self._refine(groups)
        self._look_for_files()
        if has_tracks(self.dataset):
            self._look_for_split_tracks()
        # A folder that another run has taken, or that was moved away, is found here.
        join_summary(self.out_dir, manifest)
        return self._summary(resumed)

    def _groups(self, finished: Collection[str]) -> list[FrameGroup]:
        dataset, size = self.dataset, self.options.batch_frames
        if has_tracks(dataset):
            return track_windows(dataset.frame_ids, dataset.sequence_of, size, finished)
        return frame_groups(dataset.frame_ids, size, finished)

    def _refine(self, groups: Sequence[FrameGroup]) -> None:
        start = time.perf_counter()
        reports: Iterator[GroupReport]
        if self.engine is None:
            reports = (refine_group(self.job, group) for group in groups)
        else:
            reports = reports_of(self.engine, self.job, groups)
        try:
            for report in reports:
                self._take_in(report)
        finally:
            self.timings.wall_s = time.perf_counter() - start
            # On a full disk this fails too, and the next run reads the files of the frames.
            with contextlib.suppress(OSError):
                write_timings(self.out_dir, self.timings)

    def _take_in(self, report: GroupReport) -> None:
        self.timings.add(report.timings)
        self.num_halved += report.num_halved
        for frame_id, entry in report.ends.items():
            self.ends[frame_id] = entry
            self.observer.finished(frame_id, entry.get("reason"))

    def _look_for_split_tracks(self) -> None:
        done = [frame_id for frame_id, entry in self.ends.items() if "reason" not in entry]
        frames = [read_shapes(shapes_path(self.out_dir, frame_id)) for frame_id in done]
        views = [view for shapes in frames for view in zip(shapes.tracks, shapes.track_parts, strict=True)]
        if split := sorted({track for track, part in views if part > 0}):
            self.warnings.append(f"tracks seem to be of two cars, and were split (docs/tracks.md): {_some(split)}")

    def _look_for_files(self) -> None:
        """Mark frames without files as failed, since every frame must have ended."""
        paths = [result_path, shapes_path, *([] if self.options.draw is None else [overlay_path])]
        for frame_id, entry in self.ends.items():
            if "reason" not in entry and not all(path(self.out_dir, frame_id).is_file() for path in paths):
                reason = f"its files are not in {self.out_dir}: was the folder moved or emptied during the run?"
                self.ends[frame_id] = write_failure(self.out_dir, frame_id, reason)

    def _summary(self, resumed: Collection[str]) -> RunSummary:
        frames = {frame_id: self.ends[frame_id] for frame_id in self.dataset.frame_ids}
        warnings = [*find_warnings(frames, sorted(self.dataset.classes)), *self.warnings]
        if self.num_halved:
            warnings.append(
                f"{self.num_halved} calls did not work with all of their frames and were halved: the last digits of "
                "their results may differ from those of a run that has the memory"
            )
        failed = {frame_id: entry["reason"] for frame_id, entry in sorted(frames.items()) if "reason" in entry}
        return RunSummary(frames, tuple(resumed), failed, tuple(warnings), self.timings)


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:5]) + (" .." if len(names) > 5 else "")


def has_tracks(dataset: StereoDataset) -> bool:
    """Whether the data set numbers its cars over the frames of sequences."""
    return dataset.sequence_of(dataset.frame_ids[0]) is not None


def run_manifest(dataset: StereoDataset, refiner: DirectShapeRefiner, batch_frames: int = 1) -> RunManifest:
    """All settings and files that results depend on, apart from the files of each frame.

    Device, kinds of outputs and, without tracks, batch size are excluded, because they do not change the computation.
    """
    settings: dict[str, Any] = {
        "refiner": config_to_mapping(refiner.config),
        "classes": sorted(dataset.classes),
        "ground": dataset.ground,
        "camera_height_m": dataset.camera_height_m,
        "dtype": str(refiner.prior.origin.dtype).removeprefix("torch."),
    }
    if not dataset.has_detections:
        settings["boxes"] = "masks"
    if has_tracks(dataset):
        settings["track_frames"] = batch_frames
    if (sigmas := refiner.detector_sigmas) is not None:
        settings["detector_sigmas"] = sigmas.tolist()
    if refiner.extra_terms:
        settings["extra_terms"] = [_described(make) for make in refiner.extra_terms]
    hashes = SharedHashes(prior=hash_prior(refiner.prior), stereo_bias=hash_fields(dataset.disparity_fields))
    return RunManifest(package_version(), settings, hashes, sorted(dataset.frame_ids))


def _described(make: TermFactory) -> str:
    """A factory of terms in stable words: the name of a function, or the `repr` of anything else."""
    name = getattr(make, "__qualname__", None)
    return repr(make) if name is None else f"{make.__module__}.{name}"


def package_version() -> str:
    """The installed version, or "not installed" for a source tree on the import path."""
    try:
        return importlib.metadata.version("directshape_torch")
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def check_out_dir(dataset: StereoDataset, out_dir: Path) -> None:
    """Raise `InputError` if it is not a folder or would overwrite the detections, or a folder in it is a link."""
    check_folder("out", out_dir)
    for link in (out_dir / name for name in OUTPUT_FOLDERS if (out_dir / name).is_symlink()):
        cure = "remove the link; the output folder itself may be one"
        raise InputError("out", "folders of its own in it, where results are written and removed", f"link {link}", cure)
    written, folder = (out_dir / "data").resolve(), dataset.layout.detections_dir
    for read in () if folder is None else (folder, folder / "data"):
        if written == read.resolve():
            raise InputError(
                "out", "a folder other than that of the detections", str(out_dir), "it would overwrite its own input"
            )
