"""This module writes files so that a reader sees either the old or the new content, never a part."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from directshape_torch.errors import InputError

# A path has one slash where a URL has two, and a single letter is a drive of Windows.
_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:/")


def write_bytes(path: Path | str, content: bytes, durable: bool = False) -> None:
    """Write `content` to `path` through a temporary file in the same folder, which is created if it is missing.

    Args:
        path: the file to create or replace.
        content: its bytes.
        durable: whether to wait for the disk, so that even a power failure leaves no file of another length.

    Examples:
        >>> import tempfile
        >>> folder = tempfile.mkdtemp()
        >>> write_bytes(Path(folder) / "a.txt", b"done")
        >>> (Path(folder) / "a.txt").read_bytes()
        b'done'
    """
    with replaced_file(path) as file:
        file.write(content)
        if durable:
            file.flush()
            os.fsync(file.fileno())


@contextmanager
def replaced_file(path: Path | str) -> Iterator[IO[bytes]]:
    """A temporary file that replaces `path` at the end of the body, or is removed if the body fails.

    The folder is created if it is missing. A link with this name is replaced and not followed.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.urandom(6).hex()}.tmp")
    try:
        # The file gets the permissions of any new file. `tempfile` would restrict it to its owner, and reading the
        # process's permission mask would change the mask.
        with open(temporary, "xb") as file:
            yield file
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def check_folder(name: str, path: Path) -> None:
    """Raise `InputError` if a folder cannot be created: a file or broken link is in its path, or it is a URL."""
    if _URL.match(str(path)):
        raise InputError(name, "a folder of a file system", str(path), "mount it, and give the folder where it is")
    existing = next(each for each in (path, *path.parents) if each.exists() or each.is_symlink())
    if not existing.is_dir():
        kind = "file" if existing.exists() else "broken link"
        raise InputError(name, "a folder, which is made where it is missing", f"the {kind} {existing}")


def check_file(name: str, path: Path) -> None:
    """Raise `InputError` if a file cannot be written, because its folder cannot be created or `path` is a folder."""
    check_folder(name, path.parent)
    if path.is_dir():
        raise InputError(name, "a file", f"the folder {path}")


def write_text(path: Path | str, text: str) -> None:
    """Write `text` as UTF-8 with unchanged line ends, like `write_bytes`."""
    write_bytes(path, text.encode("utf-8"))


def write_json(path: Path | str, value: Any, durable: bool = False) -> None:
    """Write `value` as JSON with sorted keys and a final newline; NaN and infinity raise, since JSON has none."""
    text = json.dumps(value, indent=2, sort_keys=True, allow_nan=False) + "\n"
    write_bytes(path, text.encode("utf-8"), durable)


def json_values(value: Any) -> Any:
    """Nested dataclasses, mappings, sequences and arrays as JSON values, with None for numbers that are not finite.

    Examples:
        >>> json_values({"sigmas": np.array([0.5, np.inf]), "line": (1, "Car")})
        {'sigmas': [0.5, None], 'line': [1, 'Car']}
    """
    if is_dataclass(value):
        return {field.name: json_values(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, dict):
        return {name: json_values(part) for name, part in value.items()}
    if isinstance(value, (np.ndarray, np.generic)):
        return json_values(value.tolist())
    if isinstance(value, (tuple, list)):
        return [json_values(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_png(path: Path | str, image: NDArray[Any]) -> None:
    """Write an image, (H, W) grey or (H, W, 3) RGB, uint8 or uint16, as PNG."""
    import cv2

    image = np.asarray(image)
    encoded, content = cv2.imencode(".png", image[..., ::-1] if image.ndim == 3 else image)
    if not encoded:
        raise OSError(f"{path}: cannot encode an array of shape {image.shape} and type {image.dtype} as PNG")
    write_bytes(path, content.tobytes())
