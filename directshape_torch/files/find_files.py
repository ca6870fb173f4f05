"""This module finds files whatever the case of endings and the encoding of accents, and remembers their content."""

from __future__ import annotations

import os
import time
import unicodedata
from collections.abc import Callable, Iterable
from functools import lru_cache, wraps
from pathlib import Path, PurePath
from typing import TypeVar

# File systems store times of changes in steps, so a folder that changed just now may change again unnoticed.
_SURELY_PAST_S = 2.0
# File systems allow 255 bytes; the rest is for endings and for the names of temporary files.
_MOST_NAME_BYTES = 200
_T = TypeVar("_T")


def is_frame_id(frame_id: object) -> bool:
    """Whether a frame's name can be used in file names and is not a path.

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
    """A file by its name, or a file whose name differs in the case of the ending or in the encoding of accents.

    macOS separates letters from accents, other systems combine them; cameras write `.JPG`. Of several matches the first
    in order is taken. The result is None if there is no such file.

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
    """A name in which letters and their accents are combined."""
    return unicodedata.normalize("NFC", name)


def is_called(path: Path, names: Iterable[str]) -> bool:
    """Whether the name of a file, without its ending, is one of `names` in any encoding of accents."""
    return composed(path.stem) in set(map(composed, names))


def visible_files(folder: Path, endings: Iterable[str]) -> list[Path]:
    """The files of a folder with one of the endings, such as ".txt", in any case, sorted by name.

    Names that begin with a dot are left out: macOS puts a `._NAME` beside each file that it copies.
    """
    wanted = frozenset(endings)
    names = sorted(name for name in _names(folder).values() if Path(name).suffix.lower() in wanted)
    # A broken link is listed too, so that opening it reports the error.
    return [folder / name for name in names if not (folder / name).is_dir()]


def _names(folder: Path) -> dict[str, str]:
    """The visible names in a folder by `_key`; the result is empty if there is no folder."""
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
    """A name in a unique spelling: accents combined, the ending in lower case."""
    stem, ending = os.path.splitext(composed(name))
    return stem + ending.lower()


def remembered(read: Callable[[Path], _T]) -> Callable[[Path | str], _T]:
    """A version of `read` with a cache, which is valid while size and time of change of the file stay the same.

    It is for files that serve many frames. Callers must not modify the result.
    """

    # The state of the file is used only as a key of the cache.
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
