"""This module reads the instance masks of both images of a frame from the files of instance segmentation tools."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from directshape_torch.errors import DataFormatError, InputError, shown
from directshape_torch.files.find_files import remembered, visible_files
from directshape_torch.files.read_files import read_json
from directshape_torch.files.text_files import Line, read_lines
from directshape_torch.io import folder_files
from directshape_torch.io.frame_layout import FrameLayout
from directshape_torch.io.image_files import find_image, read_single_channel
from directshape_torch.io.instance_masks import (
    InstanceMask,
    MaskSource,
    check_size,
    decode_segmentation,
    file_of_frame,
    read_mask,
    within_memory,
)
from directshape_torch.io.kitti_labels import frame_number
from directshape_torch.scene.frames import SIDES, Side

_COCO_CAR_ID = 3
# KITTI MOTS numbers its classes 1 car, 2 pedestrian, 10 ignore; Cityscapes numbers from 24 on, with 26 for car.
_PNG_CAR_IDS = frozenset({1, 26})
_MOTS_IGNORE_CLASS = 10
_IDS_PER_CLASS = 1000
# The instance files of KITTI's semantic benchmark have Cityscapes' classes, of which 24 to 33 have instances.
_IDS_PER_SEMANTIC_CLASS, _HIGHEST_CLASS, _FIRST_THING = 256, 33, 24
# The road of the semantic benchmark, 7 * 256, would otherwise be instance 792 of class 1.
_MOST_INSTANCES = 500
_KNOWN_CLASSES = frozenset({0, 1, 2, _MOTS_IGNORE_CLASS, *range(_FIRST_THING, _HIGHEST_CLASS + 1)})
_TRACKING_FOLDERS = ("instance_02", "instance_03")
# The index of an entry in its file comes with the entry.
_Entry = tuple[int, Mapping[str, Any]]


@dataclass(frozen=True)
class FrameJsonMasks:
    """A `FrameJsonMasks` is a folder with one file `NNNNNN.json` for each frame.

    Its entries are COCO results, each with `image`: "left" or "right". An entry may have `soft_probability`, the path
    (relative to the json file) of an 8-bit PNG of the foreground probability x 255, which replaces the binary mask.
    """

    directory: Path  # the folder, or the one above a folder `data`

    def read(self, frame_id: str, size_hw: tuple[int, int]) -> list[InstanceMask]:
        path = self.path(frame_id)
        entries = list(enumerate(read_coco_list(path)))
        return within_memory(path, _from_coco(path, entries, size_hw))

    def files(self, frame_id: str) -> tuple[Path, ...]:
        path = self.path(frame_id)
        entries = read_coco_list(path)
        soft = [path.parent / str(entry["soft_probability"]) for entry in entries if entry.get("soft_probability")]
        return (path, *soft)

    def path(self, frame_id: str) -> Path:
        """The file without which a frame has no masks.

        Raises:
            DataFormatError: an instance PNG lies in its place.
        """
        path = file_of_frame(self.directory, f"{frame_id}.json")
        if not path.is_file() and path.with_suffix(".png").is_file():
            cure = "call their folder instance_2 (instance_02 of a tracking sequence) and give the folder above it"
            raise DataFormatError(
                path.with_suffix(".png"), "is an instance PNG, and one json a frame is read", cure=cure
            )
        return path


@dataclass(frozen=True)
class InstancePngMasks:
    """An `InstancePngMasks` reads PNG files `class * 1000 + instance` in `instance_2` and (optional) `instance_3`.

    It accepts KITTI MOTS (1 car, 2 pedestrian, 10000 ignored) and Cityscapes (26 car; values below 1000 are not
    instances). Files `instance` of KITTI's semantic benchmark, `class * 256 + instance` with Cityscapes' classes, are
    recognised by their numbers.
    """

    directory: Path  # the folder above both, or above the left one only
    # Names of the two folders. Instances in `instance_02` and `instance_03`, the folders of tracking sequences, are
    # tracks.
    folders: tuple[str, str] = ("instance_2", "instance_3")

    def read(self, frame_id: str, size_hw: tuple[int, int]) -> list[InstanceMask]:
        masks: list[InstanceMask] = []
        for side, path in zip(SIDES, self.files(frame_id), strict=False):
            ids = read_single_channel(path)
            check_size(path, "the instance image", ids.shape, size_hw)
            masks += within_memory(path, self._instances(path, side, ids))
        return masks

    def files(self, frame_id: str) -> tuple[Path, ...]:
        left, right = (self.directory / folder for folder in self.folders)
        return tuple(find_image(folder, frame_id) for folder in (left, right) if folder == left or right.is_dir())

    def path(self, frame_id: str) -> Path:
        """The file without which a frame has no masks."""
        return self.files(frame_id)[0]

    def _instances(self, path: Path, side: Side, ids: NDArray[Any]) -> Iterable[InstanceMask | None]:
        values = np.unique(ids).tolist()
        if ids.dtype == np.uint8 and values[-1]:
            problem = f"has 8 bits and numbers up to {values[-1]}, where class * 1000 + instance does not fit"
            raise DataFormatError(path, problem, cure="write 16 bits: 1000 * class + instance, car 1 or 26")
        per_class = _ids_per_class(values)
        for value in values:
            category, number = divmod(value, per_class)
            is_stuff = per_class == _IDS_PER_SEMANTIC_CLASS and (category < _FIRST_THING or not number)
            if is_stuff or category in (0, _MOTS_IGNORE_CLASS):
                continue
            track = number if self.folders == _TRACKING_FOLDERS else -1
            yield InstanceMask.found(side, value, category in _PNG_CAR_IDS, ids == value, track_id=track)


def _ids_per_class(values: Sequence[int]) -> int:
    """The factor of the class in instance numbers: 1000, or 256 if only that fits the classes."""
    plain, semantic = ([divmod(value, base) for value in values] for base in (_IDS_PER_CLASS, _IDS_PER_SEMANTIC_CLASS))
    known = all(category in _KNOWN_CLASSES and number < _MOST_INSTANCES for category, number in plain)
    fits = all(category <= _HIGHEST_CLASS for category, _ in semantic)
    has_things = any(category >= _FIRST_THING and number for category, number in semantic)
    is_stuff = not any(number for _, number in semantic)
    return _IDS_PER_SEMANTIC_CLASS if not known and fits and (has_things or is_stuff) else _IDS_PER_CLASS


@dataclass(frozen=True)
class MotsTextMasks:
    """A `MotsTextMasks` reads the text file of a sequence of KITTI MOTS, which describes the left images.

    Each line is `frame id class height width rle`. Instances are tracks; ids are `class * 1000 + instance`, as in PNG
    files.
    """

    path: Path

    def read(self, frame_id: str, size_hw: tuple[int, int]) -> list[InstanceMask]:
        lines = _mots_by_frame(self.path).get(frame_number(frame_id), [])
        return within_memory(self.path, (self._instance(line, size_hw) for line in lines))

    def files(self, frame_id: str) -> tuple[Path, ...]:  # one file serves all frames
        return (self.path,)

    def _instance(self, line: Line, size_hw: tuple[int, int]) -> InstanceMask | None:
        _, number, category, height, width, counts = line.text.split()
        if int(category) == _MOTS_IGNORE_CLASS:
            return None
        segmentation = {"size": [int(height), int(width)], "counts": counts}
        inside = decode_segmentation(self.path, f"line {line.number}", segmentation, size_hw)
        is_car, track = int(category) in _PNG_CAR_IDS, int(number) % _IDS_PER_CLASS
        return InstanceMask.found("left", int(number), is_car, inside, track_id=track)


@remembered
def _mots_by_frame(path: Path) -> dict[int, list[Line]]:
    """The lines of a text file of KITTI MOTS by frame number."""
    frames: dict[int, list[Line]] = {}
    for line in read_lines(path):
        words = line.text.split()
        if len(words) != 6 or not all(word.isdecimal() and len(word) < 10 for word in words[:5]):
            cure = "write 'frame id class height width rle' a line, as KITTI MOTS does"
            raise line.error(path, f"expected five whole numbers and run lengths, got {len(words)} words", cure)
        frames.setdefault(int(words[0]), []).append(line)
    return frames


@dataclass(frozen=True)
class CocoFileMasks:
    """A `CocoFileMasks` reads plain COCO result files, left and right, with the frame number as `image_id`."""

    # The files; either may be None.
    left: Path | None
    right: Path | None

    def __post_init__(self) -> None:
        if self.left is None and self.right is None:
            raise InputError("left, right", "at least one COCO result file", "none")

    def read(self, frame_id: str, size_hw: tuple[int, int]) -> list[InstanceMask]:
        # `int` would read 000046_10 as 4610.
        if not frame_id.isdecimal():
            raise InputError("frame_id", "a number, as COCO's image_id is one", repr(frame_id), "give one file a frame")
        masks = []
        for side, path in zip(SIDES, (self.left, self.right), strict=True):
            if path is not None:
                entries = _coco_by_frame(path).get(int(frame_id), [])
                masks += within_memory(path, _from_coco(path, entries, size_hw, side))
        return masks

    def files(self, frame_id: str) -> tuple[Path, ...]:  # the same two files serve all frames
        return tuple(path for path in (self.left, self.right) if path is not None)


@dataclass(frozen=True)
class LayoutMasks:
    """A `LayoutMasks` reads the masks of the frames of a layout.

    They lie in one folder (see `mask_source`), or in one folder for each sequence. Without a folder they come from the
    files of a plain folder.
    """

    layout: FrameLayout
    directory: Path | None

    def read(self, frame_id: str, size_hw: tuple[int, int]) -> list[InstanceMask]:
        files = self.layout.files(frame_id)
        if self.directory is None:
            return folder_files.masks_of(_named(files.detections), files.calibration.parent, size_hw)
        source, name = _of_frame(self.directory, files.names)
        return source.read(name, size_hw)

    def has_file(self, frame_id: str) -> bool:
        """Whether the file exists without which the frame has no masks."""
        if self.directory is None:
            return True
        source, name = _of_frame(self.directory, self.layout.files(frame_id).names)
        return not isinstance(source, (FrameJsonMasks, InstancePngMasks)) or source.path(name).is_file()

    def files(self, frame_id: str) -> tuple[Path, ...]:
        files = self.layout.files(frame_id)
        if self.directory is None:
            return folder_files.mask_files(_named(files.detections), files.calibration.parent)
        source, name = _of_frame(self.directory, files.names)
        return source.files(name)


def _named(path: Path | None) -> Path:
    """The file of a plain folder's frame, which names its masks."""
    if path is None:
        raise InputError("masks", "files of masks, where no detections name them", "none", "give a folder of masks")
    return path


def _of_frame(directory: Path, names: Sequence[str]) -> tuple[MaskSource, str]:
    """The masks of a frame's sequence, and the name of the frame there."""
    text = _mots_text(directory, names)
    if text is not None:
        return MotsTextMasks(text), Path(names[0]).name
    places = [directory / name for name in names if (directory / name).parent.is_dir()]
    source = mask_source(places[0].parent)
    stems = [place.name for place in places if place.parent == places[0].parent]
    return source, next((stem for stem in stems if source.path(stem).is_file()), stems[0])


def _mots_text(directory: Path, names: Sequence[str]) -> Path | None:
    """The text file of KITTI MOTS for a frame with these names: the file of its sequence, or the only file."""
    folders = [directory / name for name in ("", "data", "instances_txt")]
    texts = [directory] if directory.is_file() else [text for each in folders for text in visible_files(each, [".txt"])]
    of_sequence = [text for text in texts if any(name.startswith(f"{text.stem}/") for name in names)]
    is_single = not any("/" in name for name in names)
    if directory.is_file() and not (of_sequence or is_single):
        problem = f"is not of sequence {names[0].partition('/')[0]}"
        raise DataFormatError(directory, problem, cure="give the folder that holds one SEQUENCE.txt for each")
    return of_sequence[0] if of_sequence else texts[0] if is_single and len(texts) == 1 else None


def mask_source(directory: Path | str) -> FrameJsonMasks | InstancePngMasks:
    """The reader of a folder of masks: instance PNG if it contains `instance_2` (or `instance_02`), else json files."""
    directory = Path(directory)
    if not directory.is_dir():
        raise DataFormatError(directory, "is not a folder of masks", cure="give the folder of NNNNNN.json files")
    for folders in (("instance_2", "instance_3"), _TRACKING_FOLDERS):
        if (directory / folders[0]).is_dir():
            return InstancePngMasks(directory, folders=folders)
    return FrameJsonMasks(directory)


def read_coco_list(path: Path) -> list[Mapping[str, Any]]:
    """The entries of a COCO result file."""
    entries = read_json(path)
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise DataFormatError(
            path, "is not a list of COCO results", cure='write [{"image_id": .., "segmentation": ..}, ..]'
        )
    return entries


@remembered
def _coco_by_frame(path: Path) -> dict[int, list[_Entry]]:
    """The entries of a file by frame; one file contains a whole data set."""
    frames: dict[int, list[_Entry]] = {}
    for index, entry in enumerate(read_coco_list(path)):
        try:
            frames.setdefault(_whole(entry["image_id"]), []).append((index, entry))
        except (KeyError, TypeError, ValueError) as error:
            problem = f"entry {index}: 'image_id' is {shown(entry.get('image_id'))}, expected the frame's number"
            raise DataFormatError(path, problem, cure="write the number of the frame, or one file a frame") from error
    return frames


def _whole(value: Any) -> int:
    """A whole number; `int` alone would truncate fractions and accept booleans."""
    number = int(value)
    if isinstance(value, bool) or (isinstance(value, float) and number != value):
        raise ValueError(f"{value!r} is no whole number")
    return number


def _from_coco(
    path: Path,
    entries: Sequence[_Entry],
    size_hw: tuple[int, int],
    of_side: Side | None = None,  # None: each entry names its side
) -> Iterator[InstanceMask | None]:
    for index, entry in entries:
        side = of_side or entry.get("image")
        if side not in SIDES:
            raise DataFormatError(path, f"entry {index}: 'image' is {shown(side)}, expected 'left' or 'right'")
        soft, where = entry.get("soft_probability"), f"entry {index}"
        if not soft and "segmentation" not in entry:
            raise DataFormatError(
                path, f"{where} has no 'segmentation'", cure="write RLE or polygons, as COCO results do"
            )
        # Run lengths without their size are text too, but not a path.
        probability = (
            read_mask(path, where, str(soft), size_hw, path.parent)
            if soft
            else decode_segmentation(path, where, entry.get("segmentation"), size_hw)
        )
        try:
            number, is_car = int(entry.get("instance_id", index)), int(entry["category_id"]) == _COCO_CAR_ID
            mask = InstanceMask.found(side, number, is_car, probability, score=_score(entry))
        except (KeyError, TypeError, ValueError) as error:
            raise DataFormatError(path, f"entry {index}: bad or missing field ({error!r})") from error
        yield mask


def _score(entry: Mapping[str, Any]) -> float:
    """The score of an entry; an entry without a score gets 1."""
    score = 1.0 if entry.get("score") is None else float(entry["score"])
    if not np.isfinite(score):
        raise ValueError(f"score {entry['score']} is not finite")
    return score
