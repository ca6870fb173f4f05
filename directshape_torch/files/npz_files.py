"""Read npz and npy files and refuse what is none, without ever unpickling an object."""

from __future__ import annotations

import io
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from directshape_torch.errors import DataFormatError
from directshape_torch.files.read_files import read_bytes

_MOST_BYTES = 2**29
_ENCRYPTED = 1
_COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


def read_npz(path: Path | str, cure: str = "") -> dict[str, NDArray[Any]]:
    """All arrays of an npz file by name.

    Args:
        path: the file.
        cure: what to do when it cannot be used, for the message.

    Raises:
        DataFormatError: the file is missing, damaged, no npz, larger than 512 MiB unpacked, or holds Python objects.

    Examples:
        >>> import tempfile
        >>> from directshape_torch.files.atomic_files import write_npz
        >>> file = Path(tempfile.mkdtemp()) / "a.npz"
        >>> write_npz(file, {"codes": np.zeros((2, 5))})
        >>> read_npz(file)["codes"].shape
        (2, 5)
    """
    # From memory: numpy leaves the file open when it turns out to be no archive.
    content = io.BytesIO(read_bytes(path, _MOST_BYTES, cure))
    try:
        _check_entries(content)
        with np.load(content, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        # Of an entry without the ending ".npy" numpy gives the bytes.
        if others := [name for name, array in arrays.items() if not isinstance(array, np.ndarray)]:
            raise ValueError(f"{others[0]} is no array")
        return arrays
    # Of an archive damaged on purpose numpy and zipfile raise whatever they come across.
    except Exception as error:
        raise DataFormatError(path, f"is no readable npz file ({error})", cure=cure) from error


def read_npy(path: Path | str, cure: str = "save it with numpy.save") -> NDArray[Any]:
    """The array of an npy file, read-only.

    Raises:
        DataFormatError: the file is missing, damaged, no npy, larger than 512 MiB, or holds Python objects.
    """
    content = read_bytes(path, _MOST_BYTES, cure)
    stream = io.BytesIO(content)
    try:
        version = np.lib.format.read_magic(stream)
        header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, is_fortran, dtype = header(stream)
        # What the header promises is asked of the bytes that are there: nothing is allocated for it.
        array = np.frombuffer(content, dtype, math.prod(shape), stream.tell())
        return array.reshape(shape, order="F" if is_fortran else "C")
    # As above.
    except Exception as error:
        raise DataFormatError(path, f"is no readable npy file ({error})", cure=cure) from error


def _check_entries(content: io.BytesIO) -> None:
    """Raise `ValueError` where an archive is larger than its budget, or packed as `numpy` never does."""
    with zipfile.ZipFile(content) as archive:
        entries = archive.infolist()
    total = sum(entry.file_size for entry in entries)
    if total > _MOST_BYTES:
        raise ValueError(f"unpacked it has {total} bytes, at most {_MOST_BYTES} are read")
    for entry in entries:
        if entry.flag_bits & _ENCRYPTED or entry.compress_type not in _COMPRESSIONS:
            raise ValueError(f"{entry.filename} is encrypted or not compressed by deflation")
