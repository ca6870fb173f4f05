"""Files are found with upper-case endings and with any encoding of accents; hidden files are ignored."""

from __future__ import annotations

from pathlib import Path

from directshape_torch.files.find_files import found, visible_files


def test_the_very_name_wins_and_stems_keep_their_capitals(tmp_path: Path) -> None:
    for name in ("a.PNG", "a.png", "B.png"):
        (tmp_path / name).touch()
    assert found(tmp_path / "a.png") == tmp_path / "a.png"
    assert found(tmp_path / "a.PNG") == tmp_path / "a.PNG"
    assert found(tmp_path / "b.png") is None
    assert found(tmp_path / "nowhere" / "a.png") is None


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
