"""Data sets with names and texts written by other systems are read."""

from __future__ import annotations

import codecs
import unicodedata
from pathlib import Path

import pytest
from helpers.layouts import write_folder

from directshape_torch.io.stereo_dataset import StereoDataset, open_dataset


def opened(kitti: Path) -> StereoDataset:
    return open_dataset("kitti", kitti, kitti / "detections", kitti / "masks")


def texts_of(kitti: Path) -> list[Path]:
    return [path for path in sorted(kitti.rglob("*")) if path.suffix in (".txt", ".json")]


def cars(dataset: StereoDataset) -> list[int]:
    return [len(dataset.load(frame_id).detections) for frame_id in dataset.frame_ids]


def test_byte_order_marks_lose_no_car_and_no_label(kitti_copy: Path) -> None:
    before = opened(kitti_copy)
    expected = cars(before), [len(before.load(name).labels or []) for name in before.frame_ids]
    texts = texts_of(kitti_copy)
    assert len(texts) >= 8
    for path in texts:
        path.write_bytes(codecs.BOM_UTF8 + path.read_bytes())
    marked = opened(kitti_copy)
    assert (cars(marked), [len(marked.load(name).labels or []) for name in marked.frame_ids]) == expected
    assert all(marked.load(name).detections.has_mask_left.any() for name in marked.frame_ids)


def test_what_the_system_puts_beside_files_is_no_frame(kitti_copy: Path) -> None:
    expected = opened(kitti_copy).frame_ids
    for path in list(kitti_copy.rglob("*")):
        if path.is_file():
            (path.parent / f"._{path.name}").write_bytes(b"\x00\x05\x16\x07")
    for name in ("README.txt", "Thumbs.db", ".DS_Store", "classes.txt"):
        (kitti_copy / "detections" / "data" / name).write_text("Cars of a street")
    dataset = opened(kitti_copy)
    assert dataset.frame_ids == expected
    assert sum(cars(dataset)) > 0


@pytest.mark.parametrize("change", [str.upper, str.capitalize])
def test_endings_in_capitals_are_read(kitti_copy: Path, change: object) -> None:
    before = opened(kitti_copy)
    expected = before.frame_ids, cars(before)
    for path in list(kitti_copy.rglob("*")):
        if path.is_file():
            path.rename(path.with_name(path.stem + "." + change(path.suffix[1:])))  # type: ignore[operator]
    dataset = opened(kitti_copy)
    assert (dataset.frame_ids, cars(dataset)) == expected
    loaded = dataset.load(dataset.frame_ids[0])
    assert loaded.labels
    assert loaded.frame.ground.source == ("file",)
    assert loaded.detections.has_mask_left.any()


@pytest.mark.parametrize("name", ["frame.0001", "Straße 07 é", "日本 1", "a b 1", "x" * 150 + "1"])
@pytest.mark.parametrize("form", ["NFC", "NFD"])
def test_names_are_kept_as_the_user_gave_them(kitti_copy: Path, name: str, form: str) -> None:
    first = opened(kitti_copy).frame_ids[0]
    for path in list(kitti_copy.rglob(f"{first}.*")):
        of_detections = "detections" in path.parts
        stem = unicodedata.normalize(form if of_detections else "NFC", name)
        path.rename(path.with_name(stem + path.suffix))
    dataset = opened(kitti_copy)
    wanted = unicodedata.normalize(form, name)
    assert wanted in dataset.frame_ids
    loaded = dataset.load(wanted)
    assert loaded.frame_id == wanted
    assert loaded.detections.has_mask_left.any()


def test_links_to_files_and_folders_are_followed(kitti_copy: Path, tmp_path: Path) -> None:
    expected = cars(opened(kitti_copy))
    link = tmp_path / "linked"
    link.symlink_to(kitti_copy, target_is_directory=True)
    image = next((kitti_copy / "training" / "image_2").glob("*.png"))
    image.rename(tmp_path / "elsewhere.png")
    image.symlink_to(tmp_path / "elsewhere.png")
    assert cars(opened(link)) == expected


def test_a_plain_folder_with_endings_in_capitals(kitti_copy: Path, tmp_path: Path) -> None:
    write_folder(kitti_copy, tmp_path, opened(kitti_copy).frame_ids)
    expected = cars(open_dataset("folder", tmp_path))
    for path in list((tmp_path / "frames").iterdir()):
        path.rename(path.with_suffix(".JSON"))
        (path.parent / f"._{path.name}").write_bytes(b"\x00\x05\x16\x07")
    (tmp_path / "rig.json").rename(tmp_path / "rig.JSON")
    dataset = open_dataset("folder", tmp_path)
    assert cars(dataset) == expected
    assert dataset.load(dataset.frame_ids[0]).detections.has_mask_left.any()
