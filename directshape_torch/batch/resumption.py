"""This module reads what earlier runs left in an output folder, and decides which frames need no work."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TypeVar

from directshape_torch.batch.run_summary import TIMINGS
from directshape_torch.errors import DataFormatError, ResumeError
from directshape_torch.io.result_files import read_shapes
from directshape_torch.io.run_folder import (
    done_entry,
    done_frames,
    failure_path,
    overlay_path,
    read_failure,
    read_record,
    result_path,
    shapes_path,
    summary_path,
)
from directshape_torch.io.run_manifest import (
    RESUME_CURE,
    UNKNOWN_CURE,
    FrameEntry,
    RunManifest,
    check_mapping,
    check_resume,
    hash_files,
    read_manifest,
    write_manifest,
)
from directshape_torch.io.stereo_dataset import StereoDataset

_Found = TypeVar("_Found")
# Hashing mostly waits for the disk or the network, so several threads read at a time.
_READING_THREADS = 8
_MESH = re.compile(r"(.+)_[0-9]{1,9}\.(ply|glb)")
_TRACK = re.compile(r"(.+_)?[0-9]{6,}\.npz")
OUTPUT_FOLDERS = ("data", "shapes", "meshes", "overlays", "tracks", "failed")
# A file is written within moments, but clocks of machines differ.
_STALE_S = 3600.0


class RunRecord:
    """A `RunRecord` is the summary of a folder, which follows from the files of its frames.

    Raises:
        ResumeError: the folder has results of another configuration or prior.

    Attributes:
        manifest: manifest that includes the frames of earlier runs.
        remade: frames whose files were removed or damaged after they were finished; set by `finished_frames`.
    """

    def __init__(self, out_dir: Path, manifest: RunManifest, outputs: Sequence[str], is_cleared: bool = False) -> None:
        self.out_dir, self.outputs, self.manifest = out_dir, outputs, manifest
        self.remade: list[str] = []
        if not self._takes_in_summary() and not is_cleared:
            self._check_empty()

    def finished_frames(self, dataset: StereoDataset) -> list[str]:
        """Frames of the data set that need no work, because all outputs are complete and belong to the current inputs.

        Raises:
            ResumeError: the input files of a finished frame have changed or are missing.
        """
        frames, done = self.manifest.frames, set(done_frames(self.out_dir))
        known = [f for f in dataset.frame_ids if f in done or (f in frames and frames[f]["state"] == "done")]
        checked = _in_threads(partial(self._checked, dataset), known)
        found = {frame_id: entry for frame_id, (entry, _) in checked.items() if entry is not None}
        self.remade = [frame_id for frame_id, (_, is_damaged) in checked.items() if is_damaged]
        for frame_id in self.remade:
            with suppress(OSError):
                result_path(self.out_dir, frame_id).unlink()
        frames.update(found)
        return list(found)

    def begin(self, frame_ids: Sequence[str]) -> None:
        """Write the summary with frames that wait, and remove the reasons why they have failed before."""
        self.manifest.frames.update({frame_id: {"state": "waiting"} for frame_id in frame_ids})
        waiting = set(frame_ids)
        for path in (self.out_dir / "failed").glob("*.txt"):
            if path.stem in waiting:
                path.unlink()
        self.write()

    def gather(self) -> None:
        """Add what the files in the folder say, also those of other runs into it.

        Raises:
            ResumeError: another run has begun in the folder, with other settings.
        """
        self._takes_in_summary()
        frames = self.manifest.frames
        is_done = {name for name, entry in frames.items() if entry["state"] == "done"}
        unknown = [frame_id for frame_id in done_frames(self.out_dir) if frame_id not in is_done]
        entries = _in_threads(self._entry, unknown)
        frames.update({frame_id: entry for frame_id, entry in entries.items() if entry is not None})
        for name, entry in frames.items():
            if entry["state"] == "waiting" and failure_path(self.out_dir, name).is_file():
                frames[name] = {"state": "failed", "reason": read_failure(self.out_dir, name)}

    def write(self) -> None:
        """Write `summary.json`."""
        write_manifest(summary_path(self.out_dir), self.manifest)

    def _takes_in_summary(self) -> bool:
        """Take in the frames of the summary in the folder, and say whether there is one."""
        previous = read_manifest(summary_path(self.out_dir))
        if previous is None:
            return False
        check_resume(previous, self.manifest)
        for frame_id, entry in previous.frames.items():
            self.manifest.frames.setdefault(frame_id, entry)
        return True

    def _entry(self, frame_id: str) -> FrameEntry | None:
        return done_entry(self.out_dir, frame_id, self.manifest.hash, self.outputs)

    def _checked(self, dataset: StereoDataset, frame_id: str) -> tuple[FrameEntry | None, bool]:
        """The entry of a finished frame, or None, and whether an unfinished frame has lost files."""
        try:
            path = shapes_path(self.out_dir, frame_id)
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
        entry = self._entry(frame_id)
        return entry, entry is None and set(self.outputs) <= set(record.outputs)

    def _check_empty(self) -> None:
        for name in ("data", "shapes"):
            folder = self.out_dir / name
            if folder.is_dir() and any(folder.iterdir()):
                raise ResumeError(
                    f"cannot resume: {folder} holds files, but {summary_path(self.out_dir)} is missing, so what they "
                    f"were made of is unknown; {UNKNOWN_CURE}"
                )


def _in_threads(read: Callable[[str], _Found], frame_ids: Sequence[str]) -> dict[str, _Found]:
    with ThreadPoolExecutor(_READING_THREADS) as threads:
        return dict(zip(frame_ids, threads.map(read, frame_ids), strict=True))


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
    frame_ids = {*previous.frames, *done_frames(out_dir)}
    for frame_id in frame_ids:
        for path_of in (result_path, shapes_path, overlay_path, failure_path):
            path_of(out_dir, frame_id).unlink(missing_ok=True)
    for mesh in (out_dir / "meshes").glob("*"):
        if (found := _MESH.fullmatch(mesh.name)) is not None and found[1] in frame_ids:
            mesh.unlink()
    for track in (out_dir / "tracks").glob("*.npz"):
        if _TRACK.fullmatch(track.name) is not None:
            track.unlink()
    for path in (out_dir / TIMINGS, summary_path(out_dir)):
        path.unlink(missing_ok=True)
    for name in OUTPUT_FOLDERS:
        with suppress(OSError):  # files of other origin stay, and so does their folder
            (out_dir / name).rmdir()
    return True
