"""Names of frames, which become names of files and are never paths."""

from __future__ import annotations

from pathlib import PurePath

from directshape_torch.errors import InputError, shown

# What is left of the 255 that file systems take belongs to endings and to the names of temporary files.
_MOST_BYTES = 200


def check_frame_id(argument: str, frame_id: object) -> None:
    """Raise `InputError` unless a frame's name can be that of its files: printable, and one part of a path.

    Examples:
        >>> check_frame_id("frames", "000107")
        >>> check_frame_id("frames", "../107")
        Traceback (most recent call last):
        ...
        directshape_torch.errors.InputError: frames: expected names without folders, got '../107'; rename the files
    """
    if not is_frame_id(frame_id):
        raise InputError(
            argument,
            "names without folders",
            shown(frame_id),
            "rename the files",
        )


def is_frame_id(frame_id: object) -> bool:
    """Whether a frame's name can be that of its files.

    Examples:
        >>> is_frame_id("000107"), is_frame_id("/etc/passwd"), is_frame_id("..")
        (True, False, False)
    """
    return (
        isinstance(frame_id, str)
        and frame_id.isprintable()
        and len(frame_id.encode()) <= _MOST_BYTES
        and "\\" not in frame_id
        and frame_id not in ("", "..")
        and frame_id == PurePath(frame_id).name
    )
