"""This module chooses frames by their ids, numbers and images, as users and files of splits write them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path, PurePath

from directshape_torch.errors import InputError, shown
from directshape_torch.files.find_files import composed, is_frame_id
from directshape_torch.files.text_files import read_lines
from directshape_torch.io.frame_layout import FrameLayout
from directshape_torch.io.image_files import IMAGE_ENDINGS


def chosen_frames(layout: FrameLayout, split: Path | str | None, frames: Iterable[str | int] | None) -> tuple[str, ...]:
    """The frames of a layout that a file and a list choose; raises `InputError` if none is left."""
    known = layout.frame_ids()
    known = known if split is None else frames_of_split(split, known, partial(_has_image, layout), layout.sequence)
    folder = layout.detections_dir
    where = f"{folder or 'the left images'}" if split is None else f"{split}"
    if not known:
        is_file = split is None and folder is not None
        files = f"detection file {layout.detection_file_name} in" if is_file else "frame in"
        cure = "name the folder that holds these files" if split is None else ""
        raise InputError("frames", f"at least one {files} {where}", "none", cure)
    known = known if frames is None else frames_among(known, frames, f"ids that occur in {where}")
    for frame_id in known:
        if not is_frame_id(frame_id):
            where = "frames" if split is None else f"{split}, frames"
            raise InputError(where, "names without folders", shown(frame_id), "rename the files")
    return tuple(known)


def _has_image(layout: FrameLayout, frame_id: str) -> bool:
    """Whether there is a frame with the given name, which may be any word."""
    try:
        return layout.files(frame_id).left.is_file()
    except InputError:
        return False


def frames_among(known: Sequence[str], wanted: Iterable[str | int], expected: str) -> list[str]:
    """The known frames with the given ids or numbers (leading zeros are optional), each once.

    A number may omit an ending that all frames share: 7 is `000007_10`, the first pair of a scene of KITTI Stereo 2015.

    Raises:
        InputError: a frame is unknown, which the error says in the words of `expected`; or `wanted` is one word or
            number.

    Examples:
        >>> frames_among(["000007", "000012"], [12, "7"], "frames of a run")
        ['000012', '000007']
    """
    if isinstance(wanted, (str, int)):
        raise InputError("frames", "a list of ids or numbers", repr(wanted), f"give [{wanted!r}]")
    found = _by_name(known)
    words = {word: word if word in found else _key(word) for word in map(str, wanted)}
    if missing := [word for word, key in words.items() if key not in found]:
        example = f", such as {known[0]}" if known else ""
        raise InputError("frames", f"{expected}{example}", ", ".join(missing[:5]), "check the choice of frames")
    return list(dict.fromkeys(found[key] for key in words.values()))


def frames_of_split(
    path: Path | str, known: Sequence[str], exists: Callable[[str], bool] = lambda _: False, sequence: str = ""
) -> list[str]:
    """The frames that the lines of a file name, each once.

    A line is an id, a number with or without leading zeros, a path that ends in an id (`image_2/000107.png`), or folder
    and number of a drive as in lists for KITTI's raw data (`2011_09_26/2011_09_26_drive_0005_sync 0000000005 l`).

    Args:
        path: the file of the split.
        known: frames with detections.
        exists: whether a frame with a name exists; a frame without detections is reported when it is loaded.
        sequence: name of the sequence of the frames, which must be the first word of a line with two words; "" if it is
            not known.

    Raises:
        DataFormatError: a line names no frame.
    """
    found = _by_name(known)
    chosen = []
    for line in read_lines(path):
        folder, *others = (PurePath(word).name for word in line.text.split())
        other = next(iter(others), "")
        words = [line.text, f"{folder}_{other}", _frame_word(folder, other, sequence, found)]
        names = [name for word in words for name in (word, _without_ending(word))]
        keys = [key for name in names for key in (name, _key(name)) if key in found]
        unknown = [name for name in names if is_frame_id(name) and exists(name)] if not keys else []
        if not keys and not unknown:
            example = f", such as {known[0]}" if known else ""
            raise line.error(path, "names no frame of the data", f"write one id a line{example}")
        chosen.append(found[keys[0]] if keys else unknown[0])
    return list(dict.fromkeys(chosen))


def _frame_word(folder: str, other: str, sequence: str | None, found: Mapping[str, str]) -> str:
    """The first or second word of a line, if it names a frame of the sequence, or "" for another sequence."""
    is_frame, other_is_frame = (
        bool({_key(word), _key(_without_ending(word))} & found.keys()) for word in (folder, other)
    )
    if not other_is_frame or (is_frame and not sequence):
        return folder
    return other if sequence in ("", folder) else ""


def _by_name(known: Sequence[str]) -> dict[str, str]:
    """Frames by their ids and by their numbers; ids take precedence."""
    of_number = {_key(name.removesuffix("_10")): name for name in reversed(known)}
    return of_number | {name: name for name in known}


def _without_ending(word: str) -> str:
    """A name without the ending of an image, a scan or a file of detections."""
    name = PurePath(word)
    return name.stem if name.suffix.lower() in (*IMAGE_ENDINGS, ".bin", ".txt", ".json") else word


def _key(word: str) -> str:
    """A number without leading zeros, or another name in one spelling of its accents."""
    return word.lstrip("0") or "0" if word.isdecimal() else composed(word)
