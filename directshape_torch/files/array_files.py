"""This module reads and writes npz files of numpy; sizes are checked first and nothing is unpickled."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from directshape_torch.errors import DataFormatError
from directshape_torch.files.atomic_files import write_bytes
from directshape_torch.files.read_files import MOST_BYTES, read_bytes

# This is the earliest date of a zip entry; a constant date makes equal content give equal bytes.
_ZIP_DATE = (1980, 1, 1, 0, 0, 0)
_ENCRYPTED = 1
_COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


def write_npz(path: Path | str, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write a compressed npz whose bytes depend only on the arrays (`numpy.savez` stores the time of day)."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, array in arrays.items():
            entry = zipfile.ZipInfo(f"{name}.npy", date_time=_ZIP_DATE)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.create_system = 3  # equal bytes on every operating system
            content = io.BytesIO()
            np.lib.format.write_array(content, np.asarray(array), allow_pickle=False)
            archive.writestr(entry, content.getvalue())
    write_bytes(path, buffer.getvalue())


def read_npz(path: Path | str, cure: str = "") -> dict[str, NDArray[Any]]:
    """All arrays of an npz file by name.

    Raises:
        DataFormatError: the file is missing, damaged, not an npz, larger than 512 MiB unpacked, or has Python objects.

    Examples:
        >>> import tempfile
        >>> file = Path(tempfile.mkdtemp()) / "a.npz"
        >>> write_npz(file, {"codes": np.zeros((2, 5))})
        >>> read_npz(file)["codes"].shape
        (2, 5)
    """
    # The archive is read from memory, because numpy leaves a file open if it is not an archive.
    content = io.BytesIO(read_bytes(path, cure=cure))
    try:
        _check_entries(content)
        with np.load(content, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        # For an entry without the ending ".npy" numpy returns bytes.
        if others := [name for name, array in arrays.items() if not isinstance(array, np.ndarray)]:
            raise ValueError(f"{others[0]} is no array")
        return arrays
    # A manipulated archive can raise any error in numpy and zipfile.
    except Exception as error:
        raise DataFormatError(path, f"is no readable npz file ({error})", cure=cure) from error


def _check_entries(content: io.BytesIO) -> None:
    """Raise `ValueError` if an archive is larger than its limit, or packed in a way that `numpy` does not use."""
    with zipfile.ZipFile(content) as archive:
        entries = archive.infolist()
    total = sum(entry.file_size for entry in entries)
    if total > MOST_BYTES:
        raise ValueError(f"unpacked it has {total} bytes, at most {MOST_BYTES} are read")
    for entry in entries:
        if entry.flag_bits & _ENCRYPTED or entry.compress_type not in _COMPRESSIONS:
            raise ValueError(f"{entry.filename} is encrypted or not compressed by deflation")
