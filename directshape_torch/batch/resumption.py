"""This module reads what earlier runs left in an output folder, and decides which frames need no work."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

from directshape_torch.batch.run_summary import TIMINGS
from directshape_torch.errors import DataFormatError, ResumeError
from directshape_torch.io.result_files import read_shapes
from directshape_torch.io.run_folder import (
    FrameEntry,
    done_entry,
    done_frames,
    failure_path,
    overlay_path,
    read_record,
    result_path,
    shapes_path,
    summary_path,
)
from directshape_torch.io.run_manifest import (
    RESUME_CURE,
    UNKNOWN_CURE,
    RunManifest,
    check_mapping,
    check_resume,
    hash_files,
    read_manifest,
    write_manifest,
)
from directshape_torch.io.stereo_dataset import StereoDataset

# Hashing mostly waits for the disk or the network, so several threads read at a time.
_READING_THREADS = 8
OUTPUT_FOLDERS = ("data", "shapes", "overlays", "failed")
# A file is written within moments, but clocks of machines differ.
_STALE_S = 3600.0


def check_folder_of(out_dir: Path, manifest: RunManifest, is_cleared: bool) -> None:
    """Raise `ResumeError` if the folder has results of another configuration or prior, or of unknown origin."""
    if (previous := read_manifest(summary_path(out_dir))) is not None:
        check_resume(previous, manifest)
        return
    for folder in () if is_cleared else (out_dir / "data", out_dir / "shapes"):
        if folder.is_dir() and any(folder.iterdir()):
            raise ResumeError(
                f"cannot resume: {folder} holds files, but {summary_path(out_dir)} is missing, so what they were made "
                f"of is unknown; {UNKNOWN_CURE}"
            )


def join_summary(out_dir: Path, manifest: RunManifest) -> None:
    """Write `summary.json` with the frames of this and of other runs into the folder.

    Raises:
        ResumeError: another run has begun in the folder, with other settings.
    """
    with _locked(out_dir):
        if (previous := read_manifest(summary_path(out_dir))) is not None:
            check_resume(previous, manifest)
            manifest = replace(manifest, frames=sorted({*previous.frames, *manifest.frames}))
        write_manifest(summary_path(out_dir), manifest)


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Let other runs that begin or end at the same moment wait, where the system can lock a folder."""
    try:
        import fcntl
    except ImportError:  # Only Unix has it.
        yield
        return
    folder.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):  # Some network disks have no locks.
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def finished_frames(
    out_dir: Path, dataset: StereoDataset, run: str, outputs: Sequence[str]
) -> tuple[dict[str, FrameEntry], list[str]]:
    """The entries of frames that need no work, and frames that were finished and have lost files, which are removed.

    The files of finished frames are complete, unchanged and made by the run with the hash `run`.

    Raises:
        ResumeError: the input files of a finished frame have changed or are missing.
    """

    def checked(frame_id: str) -> tuple[FrameEntry | None, bool]:
        """The entry of a finished frame, or None, and whether an unfinished frame has lost files."""
        try:
            path = shapes_path(out_dir, frame_id)
            record = read_record(path, read_shapes(path))
        except DataFormatError:
            return None, True
        try:
            hashes = hash_files(dataset.input_files(frame_id))
        except DataFormatError as error:
            raise ResumeError(
                f"cannot resume: frame {frame_id} was refined from a file that is gone: {error}; {RESUME_CURE}"
            ) from error
        check_mapping(f"frame {frame_id}: sha256 of", record.inputs, hashes)
        entry = done_entry(out_dir, frame_id, run, outputs)
        return entry, entry is None and set(outputs) <= set(record.outputs)

    written = {path.stem for path in (out_dir / "shapes").glob("*.npz")}
    known = [frame_id for frame_id in dataset.frame_ids if frame_id in written]
    with ThreadPoolExecutor(_READING_THREADS) as threads:
        ends = dict(zip(known, threads.map(checked, known), strict=True))
    damaged = [frame_id for frame_id, (_, is_damaged) in ends.items() if is_damaged]
    for frame_id in damaged:
        with suppress(OSError):
            result_path(out_dir, frame_id).unlink()
    return {frame_id: entry for frame_id, (entry, _) in ends.items() if entry is not None}, damaged


def forget_failures(out_dir: Path, frame_ids: Iterable[str]) -> None:
    """Remove the reasons why frames have failed before."""
    wanted = set(frame_ids)
    for path in (out_dir / "failed").glob("*.txt"):
        if path.stem in wanted:
            path.unlink(missing_ok=True)


def remove_stale_files(out_dir: Path) -> None:
    """Remove temporary files of killed processes; files of the last hour may belong to another run that is at work."""
    for folder in (out_dir, *(out_dir / name for name in OUTPUT_FOLDERS)):
        for path in folder.glob(".*.tmp"):
            with suppress(FileNotFoundError):  # the other run has just moved it to its name
                if path.stat().st_mtime < time.time() - _STALE_S:
                    path.unlink()


def remove_results(out_dir: Path) -> bool:
    """Remove the files that runs have written, and no others; without a summary remove nothing and return False."""
    previous = read_manifest(summary_path(out_dir))
    if previous is None:
        return False
    for frame_id in {*previous.frames, *done_frames(out_dir)}:
        for path_of in (result_path, shapes_path, overlay_path, failure_path):
            path_of(out_dir, frame_id).unlink(missing_ok=True)
    for path in (out_dir / TIMINGS, summary_path(out_dir)):
        path.unlink(missing_ok=True)
    for name in OUTPUT_FOLDERS:
        with suppress(OSError):  # files of other origin stay, and so does their folder
            (out_dir / name).rmdir()
    return True
