"""This module finds the files that a user means, and remembers what was read from files that have not changed.

Capitals of endings and the spelling of accents make no difference.
"""

from __future__ import annotations

import os
import time
import unicodedata
from collections.abc import Callable, Iterable
from functools import lru_cache, wraps
from pathlib import Path, PurePath
from typing import TypeVar

# File systems note the time of a change in steps: a folder that changed just now may change again unseen.
_SURELY_PAST_S = 2.0
# What is left of the 255 that file systems take belongs to endings and to the names of temporary files.
_MOST_NAME_BYTES = 200
_T = TypeVar("_T")


def is_frame_id(frame_id: object) -> bool:
    """Whether a frame's name can be that of its files, and is no path.

    Examples:
        >>> is_frame_id("000107"), is_frame_id("/etc/passwd"), is_frame_id("..")
        (True, False, False)
    """
    return (
        isinstance(frame_id, str)
        and frame_id.isprintable()
        and len(frame_id.encode()) <= _MOST_NAME_BYTES
        and "\\" not in frame_id
        and frame_id not in ("", "..")
        and frame_id == PurePath(frame_id).name
    )


def found(path: Path) -> Path | None:
    """A file by its name; else the one whose ending has other capitals, or whose letters are composed otherwise.

    macOS writes an accent and its letter apart, other systems together; cameras write `.JPG`. Of several the first in
    order is taken. None: there is no such file.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = (Path(folder) / "000000.PNG").write_bytes(b"")
        ...     found(Path(folder) / "000000.png").name
        '000000.PNG'
    """
    if path.is_file():
        return path
    name = _names(path.parent).get(_key(path.name))
    return None if name is None or not (path.parent / name).is_file() else path.parent / name


def composed(name: str) -> str:
    """The spelling of a name in which letters and their accents are one."""
    return unicodedata.normalize("NFC", name)


def is_called(path: Path, names: Iterable[str]) -> bool:
    """Whether a file has one of some names, without its ending and however accents are written."""
    return composed(path.stem) in set(map(composed, names))


def visible_files(folder: Path, endings: Iterable[str]) -> list[Path]:
    """The files of a folder with one of some endings, such as ".txt", in whatever capitals, sorted by name.

    Names that begin with a dot are no user's: macOS puts a `._NAME` beside each file that it copies.
    """
    wanted = frozenset(endings)
    names = sorted(name for name in _names(folder).values() if Path(name).suffix.lower() in wanted)
    # A broken link is somebody's file: that it leads nowhere is said when it is opened.
    return [folder / name for name in names if not (folder / name).is_dir()]


def _names(folder: Path) -> dict[str, str]:
    """The visible names in a folder by `_key`; nothing where there is no folder."""
    try:
        changed_ns = folder.stat().st_mtime_ns
    except OSError:
        return {}
    if time.time() - changed_ns / 1e9 < _SURELY_PAST_S:
        return _listed(folder)
    return _remembered(folder, changed_ns)


@lru_cache(maxsize=64)
def _remembered(folder: Path, _changed_ns: int) -> dict[str, str]:
    return _listed(folder)


def _listed(folder: Path) -> dict[str, str]:
    try:
        names = sorted(os.listdir(folder), reverse=True)
    except OSError:
        return {}
    return {_key(name): name for name in names if not name.startswith(".")}


def _key(name: str) -> str:
    """A name as all spellings of it are: letters composed, the ending in small ones."""
    stem, ending = os.path.splitext(composed(name))
    return stem + ending.lower()


def remembered(read: Callable[[Path], _T]) -> Callable[[Path | str], _T]:
    """What `read` makes of a file, kept while its size and time of change stay the same: for files that serve many
    frames. Whoever gets it leaves it as it is."""

    # With the state of the file, which is looked at only as a key.
    @lru_cache(maxsize=256)
    def in_state(path: Path, _size_bytes: int, _changed_ns: int) -> _T:
        return read(path)

    @wraps(read)
    def of_path(path: Path | str) -> _T:
        path = Path(path)
        if not path.is_file():
            return read(path)
        state = path.stat()
        return in_state(path, state.st_size, state.st_mtime_ns)

    return of_path
