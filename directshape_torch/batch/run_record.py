"""`summary.json` while a run goes on: what may be skipped, what happened, written now and then and at the end."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from directshape_torch.batch.frame_outputs import overlay_path
from directshape_torch.errors import DataFormatError, ResumeError
from directshape_torch.io.refinement_files import result_path, shapes_path
from directshape_torch.io.run_manifest import (
    RunManifest,
    check_inputs,
    check_resume,
    hash_files,
    read_manifest,
    write_manifest,
)
from directshape_torch.io.stereo_dataset import StereoDataset

# The file grows with the data set: writing it after every frame would cost the square of their number.
_SECONDS_BETWEEN_WRITES = 5.0


class RunRecord:
    """The manifest of an output folder, continued from an earlier run where there was one.

    Args:
        out_dir: the output folder.
        manifest: settings and hashes of this run, without frames.

    Raises:
        ResumeError: the folder holds results of other settings, or results without a summary.
    """

    def __init__(self, out_dir: Path, manifest: RunManifest) -> None:
        self.out_dir = out_dir
        self.path = out_dir / "summary.json"
        self.manifest = self._continued(manifest)
        self.write()

    def finished_frames(self, dataset: StereoDataset, outputs: Sequence[str]) -> list[str]:
        """Frames of the data set that need no work: done, with all the outputs, from the files as they are now.

        Raises:
            ResumeError: the files of a finished frame have changed since, or are gone.
        """
        finished = []
        for frame_id in dataset.frame_ids:
            if not self.manifest.is_done(frame_id):
                continue
            self._check_inputs(dataset, frame_id)
            if self._has_outputs(frame_id, outputs):
                finished.append(frame_id)
        return finished

    def add(self, frame_id: str, inputs: dict[str, str], entry: dict[str, Any]) -> None:
        """Note how a frame ended; outputs of an earlier run that are still valid stay listed."""
        earlier = self.manifest.frames.get(frame_id, {})
        if entry["state"] == "done" and self.manifest.is_done(frame_id):
            lists = ("outputs", "mesh_files")
            entry = {**entry, **{name: sorted({*earlier.get(name, ()), *entry[name]}) for name in lists}}
        self.manifest.inputs[frame_id] = inputs
        self.manifest.frames[frame_id] = entry
        if time.monotonic() - self._written_at > _SECONDS_BETWEEN_WRITES:
            # On a full disk the frames go on, each to its own error; the write at the end is the one that counts.
            with suppress(OSError):
                self.write()

    def write(self) -> None:
        """Write `summary.json`."""
        write_manifest(self.path, self.manifest)
        self._written_at = time.monotonic()

    def _continued(self, manifest: RunManifest) -> RunManifest:
        previous = read_manifest(self.path)
        if previous is None:
            self._check_empty()
            return manifest
        check_resume(previous, manifest)
        return RunManifest(manifest.package_version, manifest.config, manifest.sha256, previous.inputs, previous.frames)

    def _check_empty(self) -> None:
        for name in ("data", "shapes"):
            folder = self.out_dir / name
            if folder.is_dir() and any(folder.iterdir()):
                raise ResumeError(
                    f"cannot resume: {folder} holds files, but {self.path} is missing, so what they were made of is "
                    "unknown; choose another output folder, or remove this one to start again"
                )

    def _has_outputs(self, frame_id: str, outputs: Sequence[str]) -> bool:
        """Whether the outputs were written, and nobody has removed them since."""
        paths = {"data": result_path, "shapes": shapes_path, "overlays": overlay_path}
        entry = self.manifest.frames[frame_id]
        files = [path(self.out_dir, frame_id) for name, path in paths.items() if name in outputs]
        files += [self.out_dir / name for name in entry.get("mesh_files", ()) if f"meshes_{name[-3:]}" in outputs]
        return set(outputs) <= set(entry["outputs"]) and all(file.is_file() for file in files)

    def _check_inputs(self, dataset: StereoDataset, frame_id: str) -> None:
        try:
            hashes = hash_files(dataset.input_files(frame_id))
        except DataFormatError as error:
            raise ResumeError(
                f"cannot resume: frame {frame_id} was refined from a file that is gone: {error}"
            ) from error
        check_inputs(self.manifest, frame_id, hashes)
