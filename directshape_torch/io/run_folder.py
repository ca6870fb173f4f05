"""This module reads the output folder of `directshape refine` frame by frame; every other reader of results uses it.

A frame is done if `data/NNNNNN.txt` and `shapes/NNNNNN.npz` exist, and the latter contains the hashes of the folder's
manifest and of the former. Each file is written completely or not at all, so no further check is needed.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypedDict

import numpy as np

from directshape_torch.config import RefinerConfig
from directshape_torch.errors import ConfigError, DataFormatError
from directshape_torch.files.find_files import is_frame_id
from directshape_torch.files.read_files import parse_json, read_bytes
from directshape_torch.files.schema import record_of
from directshape_torch.io.config_files import config_from_mapping
from directshape_torch.io.frame_choice import frames_among
from directshape_torch.io.kitti_labels import KittiObject, read_objects
from directshape_torch.io.result_files import ShapeArrays, read_shapes
from directshape_torch.io.run_manifest import hash_bytes, read_manifest
from directshape_torch.status import Status

_AGAIN = "refine the frame again"
# An entry names cars whose probability to be not worse is below `_SURE`, at most `_MOST_DOUBTFUL` of a frame.
_SURE, _MOST_DOUBTFUL = 0.95, 3
# File names in a record must stay within the folder, since anybody may have written them.
_FILE = re.compile(r"[a-z]+/[^/\\]+")


def summary_path(out_dir: Path | str) -> Path:
    """The file that describes how the results of a folder were made."""
    return Path(out_dir) / "summary.json"


def result_path(out_dir: Path | str, frame_id: str) -> Path:
    """`data/ID.txt`, KITTI's result file of a frame."""
    return Path(out_dir) / "data" / f"{frame_id}.txt"


def shapes_path(out_dir: Path | str, frame_id: str) -> Path:
    """The file of states and shapes of a frame."""
    return Path(out_dir) / "shapes" / f"{frame_id}.npz"


def overlay_path(out_dir: Path | str, frame_id: str) -> Path:
    """The picture of a frame."""
    return Path(out_dir) / "overlays" / f"{frame_id}.png"


def failure_path(out_dir: Path | str, frame_id: str) -> Path:
    """The file with the reason why a frame could not be refined."""
    return Path(out_dir) / "failed" / f"{frame_id}.txt"


class FrameEntry(TypedDict, total=False):
    """A `FrameEntry` says how a frame ended: a failed frame has only `reason`, a frame that is done has the rest."""

    reason: str
    lines: int
    cars: int
    masks_left: int
    masks_right: int
    ground_source: str
    statuses: dict[str, int]  # numbers of cars
    no_mask: dict[str, str]  # reasons, by line
    # Expected numbers of refined cars, and the probability to be not worse and the standard deviations from the box of
    # cars that are most probably worse, by line.
    better: float
    worse: float
    doubtful: dict[str, list[float]]


@dataclass(frozen=True)
class FrameRecord:
    """A `FrameRecord` says how the files of a frame were made; `shapes/NNNNNN.npz` contains it."""

    run: str  # hash of the manifest
    inputs: Mapping[str, str]  # sha256 of the files of the data set, by their role
    outputs: Sequence[str]  # folders in which the frame has files: "data", "shapes", "overlays"
    files: Mapping[str, str]  # sha256 of each file but the one with this record, by path in the output folder
    lines: int  # number of lines in the detection file
    masks_right: int  # number of cars with a mask in the right image

    def files_of(self, outputs: Iterable[str]) -> dict[str, str]:
        """The entries of `files` that lie in the given folders."""
        folders = set(outputs)
        return {name: sha256 for name, sha256 in self.files.items() if name.partition("/")[0] in folders}

    def text(self) -> str:
        """JSON text of the record for `ShapeArrays.made_of`."""
        return json.dumps(asdict(self), sort_keys=True)


def read_record(path: Path, shapes: ShapeArrays) -> FrameRecord:
    """The record in the shapes of a frame, which came from the file `path`."""
    record = record_of(path, FrameRecord, parse_json(path, shapes.made_of, _AGAIN, "was not written by a run"), _AGAIN)
    if wrong := [name for name in record.files if not _FILE.fullmatch(name)]:
        raise DataFormatError(path, f"names a file {wrong[0][:80]!r}", cure=_AGAIN)
    return record


def read_done(
    out_dir: Path, frame_id: str, run: str, outputs: Iterable[str] = ("data",)
) -> tuple[ShapeArrays, FrameRecord]:
    """The shapes and the record of a frame that is done.

    Its files in the folders `outputs` must exist with unchanged bytes, written by the run with the hash `run`.
    """
    path = shapes_path(out_dir, frame_id)
    shapes = read_shapes(path)
    record = read_record(path, shapes)
    if record.run != run:
        raise DataFormatError(path, f"was made with other settings than {summary_path(out_dir)}", cure=_AGAIN)
    if missing := set(outputs) - set(record.outputs):
        raise DataFormatError(path, f"was written without {min(missing)}", cure=_AGAIN)
    for name in (f"data/{frame_id}.txt", *record.files_of(outputs)):
        if record.files.get(name) != hash_bytes(read_bytes(out_dir / name)):
            raise DataFormatError(out_dir / name, f"has been changed, or does not belong to {path}", cure=_AGAIN)
    return shapes, record


def done_entry(out_dir: Path, frame_id: str, run: str, outputs: Iterable[str]) -> FrameEntry | None:
    """The entry of a frame for which `read_done` raises no error, else None."""
    with suppress(DataFormatError):
        return frame_entry(*read_done(out_dir, frame_id, run, outputs))
    return None


def read_failure(out_dir: Path, frame_id: str) -> str:
    """The reason why a frame could not be refined."""
    return read_bytes(failure_path(out_dir, frame_id)).decode(errors="replace").strip()


def frame_entry(shapes: ShapeArrays, record: FrameRecord) -> FrameEntry:
    """The entry of a frame that is done."""
    cars = zip(shapes.input_lines.tolist(), shapes.statuses, shapes.messages, strict=True)
    better, worse, doubtful = _expected(shapes)
    return {
        "lines": record.lines,
        "cars": len(shapes.input_lines),
        "masks_left": int(shapes.has_mask_left.sum()),
        "masks_right": record.masks_right,
        "ground_source": shapes.ground_source,
        "statuses": dict(Counter(shapes.statuses)),
        "no_mask": {str(line): message for line, status, message in cars if status == Status.no_mask.name},
        "better": better,
        "worse": worse,
        "doubtful": doubtful,
    }


def _expected(shapes: ShapeArrays) -> tuple[float, float, dict[str, list[float]]]:
    """Expected numbers of refined cars that are better and worse than their boxes, and the most doubtful cars.

    The entry of a doubtful car, by line number, is its probability to be not worse and its distance from the detector's
    box in standard deviations (-1 if it is not known).
    """
    refined = np.array([Status[name].is_refined for name in shapes.statuses], dtype=bool)
    not_worse = shapes.probabilities_not_worse
    order = [car for car in np.argsort(not_worse, kind="stable").tolist() if refined[car] and not_worse[car] < _SURE]
    distances = np.nan_to_num(shapes.distances_in_sigmas, nan=-1.0)
    doubtful = {
        str(shapes.input_lines[car]): [round(float(not_worse[car]), 3), round(float(distances[car]), 2)]
        for car in order[:_MOST_DOUBTFUL]
    }
    sums = np.nansum(shapes.probabilities_better[refined]), np.nansum(1 - not_worse[refined])
    better, worse = (round(float(total), 3) for total in sums)
    return better, worse, doubtful


@dataclass(frozen=True)
class FrameResult:
    """A `FrameResult` has the results of a run for one frame."""

    frame_id: str
    lines: tuple[KittiObject, ...]  # every line of the result file
    shapes: ShapeArrays  # states and shapes of the cars
    record: FrameRecord  # how the files were made

    @property
    def cars(self) -> list[KittiObject]:
        """The result line of each car."""
        by_number = {line.line_number: line for line in self.lines}
        return [by_number[number] for number in self.shapes.input_lines.tolist()]


class RunFolder:
    """A `RunFolder` is an output folder of `directshape refine`, also of a running or interrupted run.

    Args:
        path: folder with `summary.json`, `data` and `shapes`.
        frames: ids to read, "000107" or a number with or without zeros; default are all frames that are done.

    Attributes:
        manifest: how the results were made.
        frame_ids: the chosen frames that are done, in order.
    """

    def __init__(self, path: Path | str, frames: Iterable[str | int] | None = None) -> None:
        self.path = Path(path)
        manifest = read_manifest(summary_path(self.path))
        if manifest is None:
            cure = "give the folder of --out of 'directshape refine'"
            raise DataFormatError(summary_path(self.path), "is missing", cure=cure)
        self.manifest = manifest
        done = done_frames(self.path)
        chosen = done if frames is None else sorted(frames_among(done, frames, f"finished frames of {self.path}"))
        self.frame_ids = tuple(chosen)

    @property
    def classes(self) -> tuple[str, ...]:
        """The types of objects that were refined."""
        return tuple(self.setting("classes"))

    def setting(self, name: str) -> Any:
        """A setting of the run, by its name at the top of `config`."""
        if name not in self.manifest.config:
            raise DataFormatError(summary_path(self.path), f"has no setting {name!r}")
        return self.manifest.config[name]

    def refiner_config(self) -> RefinerConfig:
        """The settings of the refinement."""
        try:
            return config_from_mapping(RefinerConfig, self.setting("refiner"))
        except ConfigError as error:
            raise DataFormatError(summary_path(self.path), f"config.refiner: {error}") from error

    def read(self, frame_id: str) -> FrameResult:
        """The results of a frame that is done; errors are those of `read_done`."""
        shapes, record = read_done(self.path, frame_id, self.manifest.hash)
        text = result_path(self.path, frame_id)
        lines = tuple(read_objects(text))
        if not set(shapes.input_lines.tolist()) <= {line.line_number for line in lines}:
            raise DataFormatError(text, f"lacks lines of {shapes_path(self.path, frame_id)}", cure=_AGAIN)
        return FrameResult(frame_id, lines, shapes, record)


def done_frames(out_dir: Path) -> list[str]:
    """Frames that have both of their files, in order."""
    texts = {path.stem for path in (out_dir / "data").glob("*.txt")}
    stems = (path.stem for path in (out_dir / "shapes").glob("*.npz"))
    return sorted(stem for stem in stems if stem in texts and is_frame_id(stem))
