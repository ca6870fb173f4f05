"""Read npz files and refuse what is none, without ever unpickling an object."""

from __future__ import annotations

import io
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from directshape_torch.errors import DataFormatError
from directshape_torch.io.image_files import read_file_bytes

_UNREADABLE = (ValueError, zipfile.BadZipFile, zlib.error, EOFError, AttributeError, TypeError)


def read_npz(path: Path | str, cure: str = "") -> dict[str, NDArray[Any]]:
    """All arrays of an npz file by name.

    Args:
        path: the file.
        cure: what to do when it cannot be used, for the message.

    Raises:
        DataFormatError: the file is missing, damaged, no npz, or holds Python objects.

    Example:
        >>> import tempfile
        >>> from directshape_torch.io.atomic_files import write_npz
        >>> file = Path(tempfile.mkdtemp()) / "a.npz"
        >>> write_npz(file, {"codes": np.zeros((2, 5))})
        >>> read_npz(file)["codes"].shape
        (2, 5)
    """
    # From memory: numpy leaves the file open when it turns out to be no archive.
    content = io.BytesIO(read_file_bytes(path))
    try:
        with np.load(content, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except _UNREADABLE as error:
        raise DataFormatError(path, f"is no readable npz file ({error})", cure=cure) from error
