"""Whether the files of every frame are there; looks at names only, so all frames of a large data set can be asked."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from directshape_torch.errors import DataFormatError
from directshape_torch.io.stereo_files import FileStereoDataset
from directshape_torch.scene_check.finding import Finding

_NAMED = 3


def check_files(dataset: FileStereoDataset) -> list[Finding]:
    """One finding for each kind of file that is missing."""
    missing: dict[str, list[str]] = {}
    for frame_id in dataset.frame_ids:
        for role, path in _files(dataset, frame_id):
            if not path.is_file():
                missing.setdefault(role, []).append(str(path))
    return [_finding(role, paths, len(dataset)) for role, paths in missing.items()]


def _files(dataset: FileStereoDataset, frame_id: str) -> Iterable[tuple[str, Path]]:
    try:
        return [(role.rstrip("_0123456789"), path) for role, path in dataset.input_files(frame_id).items()]
    except DataFormatError as error:
        # A file that names others is itself missing, or damaged: then that is found when the frame is read.
        left, right = dataset.layout.images(frame_id)
        return [("image_left", left), ("image_right", right), ("list of masks", error.path)]


def _finding(role: str, paths: list[str], num_frames: int) -> Finding:
    more = f" and {len(paths) - _NAMED} more" if len(paths) > _NAMED else ""
    return Finding(
        "missing_files",
        "error",
        f"{len(paths)} of {num_frames} frames",
        f"no {role.replace('_', ' ')}: {', '.join(paths[:_NAMED])}{more}",
        "every frame to have all of its files",
        "add them, or leave the frames out with --split or --frames",
    )
