"""Names of frames, which become names of files and are never paths."""

from __future__ import annotations

from pathlib import PurePath

# What is left of the 255 that file systems take belongs to endings and to the names of temporary files.
_MOST_BYTES = 200


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
