"""Writers leave the complete new file or the complete old one, with equal bytes for equal content."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path

import numpy as np
import pytest

from directshape_torch.errors import InputError
from directshape_torch.files import atomic_files
from directshape_torch.files.array_files import write_npz


def test_a_failed_replacement_keeps_the_old_file_and_leaves_no_temporary(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.txt"
    atomic_files.write_text(path, "old")

    def full_disk(*_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", full_disk)
    with pytest.raises(OSError, match="disk full"):
        atomic_files.write_text(path, "new")
    assert path.read_text() == "old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.txt"]


def test_a_durable_file_is_on_the_disk_before_it_gets_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []
    real = {name: getattr(os, name) for name in ("fsync", "replace")}
    for name, function in real.items():

        def noted(*args: object, name: str = name, function: object = function) -> object:
            calls.append(name)
            return function(*args)  # type: ignore[operator]

        monkeypatch.setattr(os, name, noted)
    atomic_files.write_bytes(tmp_path / "a", b"1")
    atomic_files.write_json(tmp_path / "b", {"a": 1}, durable=True)
    assert calls == ["replace", "fsync", "replace"]
    assert json.loads((tmp_path / "b").read_text()) == {"a": 1}


def test_folders_are_made_and_line_ends_kept(tmp_path: Path) -> None:
    path = tmp_path / "new" / "folder" / "a.txt"
    atomic_files.write_text(path, "a\r\nb\n")
    assert path.read_bytes() == b"a\r\nb\n"


def test_results_are_as_readable_as_other_new_files(tmp_path: Path) -> None:
    (tmp_path / "plain").write_bytes(b"")
    atomic_files.write_bytes(tmp_path / "atomic", b"")
    assert (tmp_path / "plain").stat().st_mode == (tmp_path / "atomic").stat().st_mode


def test_npz_bytes_do_not_depend_on_the_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    arrays = {"a": np.arange(5.0), "names": np.array(["x", "yy"])}
    write_npz(tmp_path / "1.npz", arrays)
    monkeypatch.setattr(time, "time", lambda: 2e9)
    write_npz(tmp_path / "2.npz", arrays)
    assert (tmp_path / "1.npz").read_bytes() == (tmp_path / "2.npz").read_bytes()
    with np.load(tmp_path / "1.npz", allow_pickle=False) as archive:
        assert archive["names"].tolist() == ["x", "yy"]
        np.testing.assert_array_equal(archive["a"], arrays["a"])


def test_npz_refuses_python_objects(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"[Oo]bject arrays"):
        write_npz(tmp_path / "1.npz", {"a": np.array([{}], dtype=object)})
    assert not list(tmp_path.iterdir())


def test_json_is_sorted_and_refuses_nan(tmp_path: Path) -> None:
    atomic_files.write_json(tmp_path / "a.json", {"b": 1, "a": [2.5]})
    assert (tmp_path / "a.json").read_text().index('"a"') < (tmp_path / "a.json").read_text().index('"b"')
    assert json.loads((tmp_path / "a.json").read_text()) == {"a": [2.5], "b": 1}
    with pytest.raises(ValueError, match="not JSON compliant"):
        atomic_files.write_json(tmp_path / "b.json", {"a": float("nan")})


def test_where_a_broken_link_stands_no_folder_can_be_made(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    for path in (tmp_path / "link", tmp_path / "link" / "below"):
        with pytest.raises(InputError, match=f"out: expected a folder, .*, got the broken link {tmp_path}/link$"):
            atomic_files.check_folder("out", path)
