"""What an output folder knows of its frames: from the summary of earlier runs and the journals of those cut off."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from directshape_torch.batch.frame_outputs import failed_entry, overlay_path
from directshape_torch.batch.journal import FrameRecord, journal_folder, read_journals, remove_journals
from directshape_torch.batch.run_results import add_record, summary_path
from directshape_torch.errors import DataFormatError, ResumeError
from directshape_torch.files.read_files import read_bytes
from directshape_torch.io.refinement_files import result_path, shapes_path
from directshape_torch.io.run_manifest import (
    RESUME_CURE,
    RunManifest,
    check_inputs,
    check_resume,
    hash_bytes,
    hash_files,
    read_manifest,
    write_manifest,
)
from directshape_torch.io.stereo_dataset import StereoDataset

# Hashing waits for the disk most of the time, and for a network's even longer.
_READING_THREADS = 8
_OUTPUT_FOLDERS = ("data", "shapes", "meshes", "overlays")


class RunRecord:
    """The manifest of an output folder, continued from earlier runs where there were any.

    Args:
        out_dir: the output folder.
        manifest: settings and hashes of this run, without frames.
        is_cleared: the results of earlier runs were just removed, and what is left is no result.

    Attributes:
        manifest: with the frames of earlier runs.
        remade: frames whose files have been removed or damaged since they were finished, after `finished_frames`.

    Raises:
        ResumeError: the folder holds results of other settings, or results without a summary.
    """

    def __init__(self, out_dir: Path, manifest: RunManifest, is_cleared: bool = False) -> None:
        self.out_dir = out_dir
        self.path = summary_path(out_dir)
        self.remade: list[str] = []
        previous = read_manifest(self.path)
        if previous is None:
            if not is_cleared:
                self._check_empty()
            # Of a summary that somebody removed together with the results.
            remove_journals(out_dir)
            self.manifest = manifest
            self.write()
            return
        check_resume(previous, manifest)
        self.manifest = RunManifest(
            manifest.package_version, manifest.config, manifest.sha256, previous.inputs, previous.frames
        )
        self._add_journals()
        # Of runs that were cut off: taken in now, so that at the end only this run has a say.
        self.write()
        remove_journals(out_dir)

    def finished_frames(self, dataset: StereoDataset, outputs: Sequence[str]) -> list[str]:
        """Frames of the data set that need no work: done, with all the outputs whole, from the files as they are now.

        Raises:
            ResumeError: the files of a finished frame have changed since, or are gone.
        """
        done = [frame_id for frame_id in dataset.frame_ids if self.manifest.is_done(frame_id)]
        with ThreadPoolExecutor(_READING_THREADS) as threads:
            for _ in threads.map(partial(self._check_inputs, dataset), done):
                pass
            whole = list(threads.map(partial(self._has_outputs, outputs), done))
        had_outputs = [set(outputs) <= set(self.manifest.frames[frame_id].get("outputs", ())) for frame_id in done]
        self.remade = [
            frame_id for frame_id, had, is_whole in zip(done, had_outputs, whole, strict=True) if had and not is_whole
        ]
        return [frame_id for frame_id, is_whole in zip(done, whole, strict=True) if is_whole]

    def take_in_journals(self, ended: Sequence[str], outputs: Sequence[str]) -> None:
        """Add what was noted since, and write `summary.json`.

        Args:
            ended: frames that must have come to an end; one without a record or files has failed.
            outputs: kinds of files that those which are done must have.

        Raises:
            OSError: it could not be written.
        """
        self._add_journals()
        for frame_id in ended:
            entry = self.manifest.frames.get(frame_id)
            is_done = self.manifest.is_done(frame_id)
            if entry is None or (is_done and not all(map(Path.is_file, self._output_files(outputs, frame_id)))):
                reason = f"its files are not in {self.out_dir}: was the folder moved or emptied during the run?"
                self.manifest.frames[frame_id] = failed_entry(reason)
        self.write()

    def write(self) -> None:
        """Write `summary.json`."""
        write_manifest(self.path, self.manifest)

    def _add_journals(self) -> None:
        for record in read_journals(self.out_dir).records:
            if record.failure is not None and record.frame_id in self.remade:
                del self.manifest.frames[record.frame_id]
            add_record(self.manifest, record)

    def _check_empty(self) -> None:
        for name in ("data", "shapes"):
            folder = self.out_dir / name
            if folder.is_dir() and any(folder.iterdir()):
                raise ResumeError(
                    f"cannot resume: {folder} holds files, but {self.path} is missing, so what they were made of is "
                    f"unknown; {RESUME_CURE}"
                )

    def _has_outputs(self, outputs: Sequence[str], frame_id: str) -> bool:
        """Whether the outputs were written, and nobody has removed or changed them since."""
        entry = self.manifest.frames[frame_id]
        files = self._output_files(outputs, frame_id)
        return set(outputs) <= set(entry.get("outputs", ())) and all(self._is_whole(file, entry) for file in files)

    def _output_files(self, outputs: Sequence[str], frame_id: str) -> list[Path]:
        """The files of these kinds that a finished frame has."""
        paths = {"data": result_path, "shapes": shapes_path, "overlays": overlay_path}
        meshes = self.manifest.frames[frame_id].get("mesh_files", ())
        files = [path(self.out_dir, frame_id) for name, path in paths.items() if name in outputs]
        return files + [self.out_dir / name for name in meshes if f"meshes_{name[-3:]}" in outputs]

    def _is_whole(self, file: Path, entry: dict[str, Any]) -> bool:
        """Runs of earlier versions left no checksums: of their files only the existence can be told."""
        if not file.is_file():
            return False
        expected = entry.get("files", {}).get(file.relative_to(self.out_dir).as_posix())
        return expected is None or hash_bytes(read_bytes(file)) == expected

    def _check_inputs(self, dataset: StereoDataset, frame_id: str) -> None:
        try:
            hashes = hash_files(dataset.input_files(frame_id))
        except DataFormatError as error:
            raise ResumeError(
                f"cannot resume: frame {frame_id} was refined from a file that is gone: {error}; {RESUME_CURE}"
            ) from error
        check_inputs(self.manifest, frame_id, hashes)


def remove_unfinished_files(out_dir: Path) -> None:
    """Remove temporary files of processes that were killed while they wrote; only for who holds the folder's lock."""
    for folder in (out_dir, journal_folder(out_dir), *(out_dir / name for name in _OUTPUT_FOLDERS)):
        for path in folder.glob(".*.tmp"):
            path.unlink(missing_ok=True)


def remove_results(out_dir: Path, others: Iterable[str]) -> bool:
    """Remove what runs have written into a folder, and nothing else: the files their records name.

    Args:
        out_dir: the output folder.
        others: further files of runs, beside the summary.

    Returns:
        Whether there was a summary that names them; without one nothing is removed.

    Raises:
        DataFormatError: the folder has a summary that cannot be read, so nobody knows which files are results.
    """
    previous = read_manifest(summary_path(out_dir))
    if previous is None:
        return False
    records = [FrameRecord(frame_id, {}, entry) for frame_id, entry in previous.frames.items()]
    for record in [*records, *read_journals(out_dir).records]:
        paths = (path(out_dir, record.frame_id) for path in (result_path, shapes_path, overlay_path))
        for path in (*paths, *(out_dir / name for name in record.entry.get("mesh_files", ()))):
            # A path that was smuggled into the summary does not lead out of the folder.
            if path.resolve().is_relative_to(out_dir.resolve()):
                path.unlink(missing_ok=True)
    remove_journals(out_dir)
    for name in (*others, summary_path(out_dir).name):
        (out_dir / name).unlink(missing_ok=True)
    for name in _OUTPUT_FOLDERS:
        with suppress(OSError):  # files of somebody else stay, and their folder with them
            (out_dir / name).rmdir()
    return True
