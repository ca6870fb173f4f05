"""An npz file is read as it was written, and any other file is refused with its name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from directshape_torch.errors import DataFormatError
from directshape_torch.files.array_files import read_npz, write_npz


def test_other_content(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    with path.open("wb") as file:
        np.save(file, np.zeros(3))
    single_array = path.read_bytes()
    np.savez(path, names=np.array([{"an": "object"}]))
    for content in (b"", b"no archive", b"PK\x03\x04 broken", single_array, path.read_bytes()):
        path.write_bytes(content)
        with pytest.raises(DataFormatError, match=r"a\.npz: is no readable npz file .*make it again"):
            read_npz(path, cure="make it again")


def test_a_damaged_byte_anywhere_in_an_array(tmp_path: Path) -> None:
    """The checksum of the entry, or the decompression before it, tells."""
    path = tmp_path / "a.npz"
    write_npz(path, {"a": np.random.default_rng(0).normal(size=40)})
    whole = path.read_bytes()
    for place in range(len(whole) // 4, len(whole) // 2):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0xFF]) + whole[place + 1 :])
        with pytest.raises(DataFormatError, match="is no readable npz file"):
            read_npz(path)
