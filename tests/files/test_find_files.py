"""Files are found with upper-case endings and with any encoding of accents; hidden files are ignored."""

from __future__ import annotations

import unicodedata
from pathlib import Path

import pytest

from directshape_torch.files.find_files import found, visible_files


@pytest.mark.parametrize("name", ["000000.PNG", "000000.Png", "000000.png"])
def test_endings_in_capitals(tmp_path: Path, name: str) -> None:
    (tmp_path / name).touch()
    assert found(tmp_path / "000000.png") == tmp_path / name
    assert visible_files(tmp_path, [".png"]) == [tmp_path / name]


def test_the_very_name_wins_and_stems_keep_their_capitals(tmp_path: Path) -> None:
    for name in ("a.PNG", "a.png", "B.png"):
        (tmp_path / name).touch()
    assert found(tmp_path / "a.png") == tmp_path / "a.png"
    assert found(tmp_path / "a.PNG") == tmp_path / "a.PNG"
    assert found(tmp_path / "b.png") is None
    assert found(tmp_path / "nowhere" / "a.png") is None


@pytest.mark.parametrize("form", ["NFC", "NFD"])
def test_accents_may_be_written_either_way(tmp_path: Path, form: str) -> None:
    name = unicodedata.normalize(form, "Straße_é 01.png")
    (tmp_path / name).touch()
    for other in ("NFC", "NFD"):
        assert found(tmp_path / unicodedata.normalize(other, "Straße_é 01.png")) == tmp_path / name


def test_hidden_files_and_folders_are_none_and_links_are_files(tmp_path: Path) -> None:
    for name in ("._a.png", ".DS_Store", "a.png"):
        (tmp_path / name).touch()
    (tmp_path / "b.png").mkdir()
    (tmp_path / "c.png").symlink_to(tmp_path / "gone.png")
    (tmp_path / "d.png").symlink_to(tmp_path / "a.png")
    assert visible_files(tmp_path, [".png"]) == [tmp_path / name for name in ("a.png", "c.png", "d.png")]
    assert found(tmp_path / "b.png") is None
    assert found(tmp_path / "c.png") is None


def test_a_file_that_comes_later_is_found(tmp_path: Path) -> None:
    assert found(tmp_path / "a.png") is None
    (tmp_path / "a.PNG").touch()
    assert found(tmp_path / "a.png") == tmp_path / "a.PNG"
