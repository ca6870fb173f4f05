"""This module reads what earlier runs left in an output folder, and decides which frames need no work."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TypeVar

from directshape_torch.batch.run_summary import TIMINGS
from directshape_torch.errors import DataFormatError, ResumeError
from directshape_torch.io.result_files import read_shapes
from directshape_torch.io.run_folder import (
    done_frames,
    frame_entry,
    overlay_path,
    read_done,
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
OUTPUT_FOLDERS = ("data", "shapes", "meshes", "overlays", "tracks")


class EarlierResults:
    """An `EarlierResults` has the results of earlier runs, which a run continues; else `ResumeError` is raised.

    Attributes:
        manifest: manifest that includes the frames of earlier runs.
        remade: frames whose files were removed or damaged after they were finished; set by `finished_frames`.
    """

    def __init__(self, out_dir: Path, manifest: RunManifest, outputs: Sequence[str], is_cleared: bool = False) -> None:
        self.out_dir, self.outputs = out_dir, outputs
        self.remade: list[str] = []
        previous = read_manifest(summary_path(out_dir))
        if previous is not None:
            check_resume(previous, manifest)
            manifest.frames.update(previous.frames)
        elif not is_cleared:
            self._check_empty()
        self.manifest = manifest
        self.write()

    def finished_frames(self, dataset: StereoDataset) -> list[str]:
        """Frames of the data set that need no work, because all outputs are complete and belong to the current inputs.

        Raises:
            ResumeError: the input files of a finished frame have changed or are missing.
        """
        frames, done = self.manifest.frames, set(done_frames(self.out_dir))
        known = [f for f in dataset.frame_ids if f in done or (f in frames and frames[f]["state"] == "done")]
        checked = _in_threads(partial(self._checked, dataset), known)
        # The summary also keeps finished frames that are not chosen now.
        self.take_in(done.difference(dataset.frame_ids))
        found = {frame_id: entry for frame_id, (entry, _) in checked.items() if entry is not None}
        self.remade = [frame_id for frame_id, (_, is_damaged) in checked.items() if is_damaged]
        for frame_id in self.remade:
            frames.pop(frame_id, None)
            with suppress(OSError):
                result_path(self.out_dir, frame_id).unlink()
        frames.update(found)
        return list(found)

    def take_in(self, frame_ids: Iterable[str]) -> None:
        """Add finished frames to the summary that are not recorded there."""
        frames = self.manifest.frames
        unknown = sorted(f for f in frame_ids if f not in frames or frames[f]["state"] == "failed")
        entries = _in_threads(self.entry, unknown)
        frames.update({frame_id: entry for frame_id, entry in entries.items() if entry is not None})

    def entry(self, frame_id: str) -> FrameEntry | None:
        """The entry of a frame that has all outputs of this run, unchanged, else None."""
        with suppress(DataFormatError):
            return frame_entry(*read_done(self.out_dir, frame_id, self.manifest.hash, self.outputs))
        return None

    def write(self) -> None:
        """Write `summary.json`."""
        write_manifest(summary_path(self.out_dir), self.manifest)

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
        entry = self.entry(frame_id)
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


def remove_unfinished_files(out_dir: Path) -> None:
    """Remove temporary files of killed processes; the caller must hold the folder's lock."""
    for folder in (out_dir, *(out_dir / name for name in OUTPUT_FOLDERS)):
        for path in folder.glob(".*.tmp"):
            path.unlink(missing_ok=True)


def remove_results(out_dir: Path) -> bool:
    """Remove the files that runs have written, and no others; without a summary remove nothing and return False."""
    previous = read_manifest(summary_path(out_dir))
    if previous is None:
        return False
    frame_ids = {*previous.frames, *done_frames(out_dir)}
    for frame_id in frame_ids:
        for path_of in (result_path, shapes_path, overlay_path):
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
