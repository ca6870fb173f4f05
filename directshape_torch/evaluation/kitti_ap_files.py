"""Labels and results of the frames that an evaluation is about."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.files.text_files import read_lines
from directshape_torch.io.kitti_labels import KittiObject, read_objects

ObjectsByFrame = Mapping[str, Sequence[KittiObject]]


@dataclass(frozen=True)
class FrameObjects:
    """Labels and results, frame by frame.

    Attributes:
        frame_ids: of the F frames.
        labels, results: the objects of each; no results where there is no file.
        num_without_results: frames without a result file.
        num_results_unused: result files of other frames.
    """

    frame_ids: tuple[str, ...]
    labels: tuple[Sequence[KittiObject], ...]
    results: tuple[Sequence[KittiObject], ...]
    num_without_results: int
    num_results_unused: int


def load_frames(
    labels: Path | str | ObjectsByFrame,
    results: Path | str | ObjectsByFrame,
    split: Path | str | Sequence[str] | None = None,
) -> FrameObjects:
    """Read and check what `evaluate_kitti` was given; see there.

    Raises:
        DataFormatError: a folder, a label file or a line is missing or damaged, or a result has no score.
        InputError: no frame has labels, or none has results.
    """
    label_source, result_source = _source(labels, "labels"), _source(results, "results")
    frame_ids = _frame_ids(split, label_source)
    with_results = [frame_id for frame_id in frame_ids if frame_id in result_source]
    if not frame_ids:
        raise InputError("labels", "label files NNNNNN.txt, or a split that is not empty", _describe(labels))
    if not with_results:
        raise InputError("results", f"result files such as {frame_ids[0]}.txt", _describe(results))
    return FrameObjects(
        frame_ids=frame_ids,
        labels=tuple(_labels_of(label_source, frame_id) for frame_id in frame_ids),
        results=tuple(_results_of(result_source, frame_id) for frame_id in frame_ids),
        num_without_results=len(frame_ids) - len(with_results),
        num_results_unused=len(result_source) - len(with_results),
    )


_Source = Mapping[str, Path | Sequence[KittiObject]]


def _source(given: Path | str | ObjectsByFrame, name: str) -> _Source:
    """Where the objects of each frame are: files of a folder, or the objects themselves."""
    if isinstance(given, Mapping):
        return given
    folder = Path(given)
    nested = folder / "data"
    if not folder.is_dir():
        raise DataFormatError(folder, f"is no folder of {name}", cure="give the folder that holds the files NNNNNN.txt")
    return {path.stem: path for path in (nested if nested.is_dir() else folder).glob("*.txt")}


def _frame_ids(split: Path | str | Sequence[str] | None, labels: _Source) -> tuple[str, ...]:
    if split is None:
        return tuple(sorted(labels))
    listed = [line.text for line in read_lines(split)] if isinstance(split, (Path, str)) else split
    return tuple(dict.fromkeys(listed))


def _labels_of(source: _Source, frame_id: str) -> Sequence[KittiObject]:
    if frame_id not in source:
        raise InputError("labels", f"labels of frame {frame_id}, which the split names", "none")
    return _objects(source[frame_id])


def _results_of(source: _Source, frame_id: str) -> Sequence[KittiObject]:
    found = source.get(frame_id, ())
    objects = _objects(found)
    for o in objects:
        if o.score is None:
            raise DataFormatError(
                found if isinstance(found, Path) else f"results of frame {frame_id}",
                "a result without score",
                line_number=o.line_number,
                line=o.raw_line,
                cure="results are ranked by their score: write it as column 16",
            )
    return objects


def _objects(found: Path | Sequence[KittiObject]) -> Sequence[KittiObject]:
    return read_objects(found) if isinstance(found, Path) else found


def _describe(given: Path | str | ObjectsByFrame) -> str:
    return f"objects of {len(given)} other frames" if isinstance(given, Mapping) else f"none of these in {given}"
