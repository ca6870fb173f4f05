"""Write files so that a reader sees the old content or the new one, never half of it."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from directshape_torch.errors import InputError


def write_bytes(path: Path | str, content: bytes, durable: bool = False) -> None:
    """Write `content` to `path` by way of a temporary file in the same folder, which is made where it is missing.

    Args:
        path: the file to make or replace.
        content: its bytes.
        durable: wait for the disk, so that not even a power cut leaves a file of another length.

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
    """A file that takes the place of `path` when the body ends, and leaves it alone when the body fails.

    Its folder is made where it is missing. A link of that name is replaced and not followed.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.urandom(6).hex()}.tmp")
    try:
        # Readable like any new file: `tempfile` makes them for their owner alone, and asking for the process's mask of
        # permissions would set it.
        with open(temporary, "xb") as file:
            yield file
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def check_folder(name: str, path: Path) -> None:
    """Raise `InputError` where a folder cannot be made, for a file or broken link has its name or one above it."""
    existing = next(each for each in (path, *path.parents) if each.exists() or each.is_symlink())
    if not existing.is_dir():
        kind = "file" if existing.exists() else "broken link"
        raise InputError(name, "a folder, which is made where it is missing", f"the {kind} {existing}")


def check_file(name: str, path: Path) -> None:
    """Raise `InputError` where a file cannot be written, for its folder cannot be made or a folder has its name."""
    check_folder(name, path.parent)
    if path.is_dir():
        raise InputError(name, "a file", f"the folder {path}")


def write_text(path: Path | str, text: str) -> None:
    """Write `text` as UTF-8, line ends as they are, like `write_bytes`."""
    write_bytes(path, text.encode("utf-8"))


def write_json(path: Path | str, value: Any, durable: bool = False) -> None:
    """Write `value` as JSON with sorted keys and a final newline; NaN and infinity are refused, JSON has none."""
    text = json.dumps(value, indent=2, sort_keys=True, allow_nan=False) + "\n"
    write_bytes(path, text.encode("utf-8"), durable)


def write_png(path: Path | str, image: NDArray[Any]) -> None:
    """Write an image, (H, W) grey or (H, W, 3) RGB, uint8 or uint16, as PNG."""
    import cv2

    image = np.asarray(image)
    encoded, content = cv2.imencode(".png", image[..., ::-1] if image.ndim == 3 else image)
    if not encoded:
        raise OSError(f"{path}: cannot encode an array of shape {image.shape} and type {image.dtype} as PNG")
    write_bytes(path, content.tobytes())
