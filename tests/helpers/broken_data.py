"""Data sets in KITTI's layout, broken on purpose: each way with the findings that must name it.

Mistakes in the numbers themselves are in `scripts/scene_mistakes.py`; here are those of files, and one of each kind.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pycocotools import mask as coco

from directshape_torch.io.instance_masks import decode_segmentation

Image = NDArray[np.uint8]
Row = list[str]  # the words of a detection line: h w l at 8, x y z at 11, rotation_y at 14
P_LEFT, P_RIGHT = "P2:", "P3:"


@dataclass(frozen=True)
class Break:
    """One way to break a data set."""

    apply: Callable[[Path], None]  # changes the files below a root with `training`, `detections/data` and `masks`
    checks: frozenset[str]  # names of findings, one of which must appear


def copy_data(data: Path, detections: Path, masks: Path, to: Path, frames: list[str] | None = None) -> Path:
    """A copy that may be broken; `frames` limits it."""
    for source, target in (
        (data / "training" / "image_2", to / "training" / "image_2"),
        (data / "training" / "image_3", to / "training" / "image_3"),
        (data / "training" / "calib", to / "training" / "calib"),
        (data / "training" / "planes", to / "training" / "planes"),
        (detections, to / "detections" / "data"),
        (masks, to / "masks"),
    ):
        target.mkdir(parents=True)
        for path in source.glob("*.*"):
            if frames is None or path.stem in frames:
                shutil.copyfile(path, target / path.name)
    return to


def _images(change: Callable[[Image, Image], tuple[Image, Image]]) -> Callable[[Path], None]:
    def apply(root: Path) -> None:
        for left_path in sorted((root / "training" / "image_2").glob("*.png")):
            right_path = root / "training" / "image_3" / left_path.name
            pair = change(cv2.imread(str(left_path)), cv2.imread(str(right_path)))
            for path, image in zip((left_path, right_path), pair, strict=True):
                cv2.imwrite(str(path), image)

    return apply


def _turned(image: Image, degrees: float) -> Image:
    height, width = image.shape[:2]
    matrix = cv2.getRotationMatrix2D((width / 2, height / 2), degrees, 1.0)
    return np.asarray(cv2.warpAffine(image, matrix, (width, height), borderMode=cv2.BORDER_REFLECT), dtype=np.uint8)


def _projections(change: Callable[[NDArray[Any], NDArray[Any]], None]) -> Callable[[Path], None]:
    """`change(P2, P3)` in place."""

    def apply(root: Path) -> None:
        for path in (root / "training" / "calib").glob("*.txt"):
            lines = dict(line.split(" ", 1) for line in path.read_text().splitlines() if line.strip())
            both = [np.array(lines[name].split(), dtype=float).reshape(3, 4) for name in (P_LEFT, P_RIGHT)]
            change(*both)
            for name, P in zip((P_LEFT, P_RIGHT), both, strict=True):
                lines[name] = " ".join(repr(float(value)) for value in P.flatten())
            path.write_text("".join(f"{name} {numbers}\n" for name, numbers in lines.items()))

    return apply


def _scale_baseline(factor: float) -> Callable[[NDArray[Any], NDArray[Any]], None]:
    def change(P2: NDArray[Any], P3: NDArray[Any]) -> None:
        P3[0, 3] = P2[0, 3] + factor * (P3[0, 3] - P2[0, 3])

    return change


def _boxes(change: Callable[[Row], None]) -> Callable[[Path], None]:
    """`change(words)` in place for each line."""

    def apply(root: Path) -> None:
        for path in (root / "detections" / "data").glob("*.txt"):
            rows = [line.split() for line in path.read_text().splitlines() if line.strip()]
            for row in rows:
                change(row)
            path.write_text("".join(" ".join(row) + "\n" for row in rows))

    return apply


def _centre(row: Row) -> None:
    row[12] = f"{float(row[12]) - float(row[8]) / 2:.4f}"


def _order(*columns: int) -> Callable[[Row], None]:
    def change(row: Row) -> None:
        row[8:11] = [row[8 + column] for column in columns]

    return change


def _corner_and_size(row: Row) -> None:
    u_min, v_min, u_max, v_max = map(float, row[4:8])
    row[6:8] = [f"{u_max - u_min:.2f}", f"{v_max - v_min:.2f}"]


def _cut_short(row: Row) -> None:
    del row[12:]


def _lower_case(row: Row) -> None:
    row[0] = row[0].lower()


def _masks(change: Callable[[dict[str, Any], NDArray[Any]], NDArray[Any]]) -> Callable[[Path], None]:
    """`change(entry, mask (H, W) uint8)` gives the new mask."""

    def apply(root: Path) -> None:
        for path in (root / "masks").glob("*.json"):
            entries = json.loads(path.read_text())
            for entry in entries:
                size = entry["segmentation"]["size"]
                mask = decode_segmentation(path, "", entry["segmentation"], (size[0], size[1]))
                mask = np.asfortranarray(change(entry, mask.astype(np.uint8)))
                rle = coco.encode(mask)
                entry["segmentation"] = {"size": list(rle["size"]), "counts": rle["counts"].decode()}
                for key in ("bbox", "soft_probability"):
                    entry.pop(key, None)
            path.write_text(json.dumps(entries))

    return apply


def _other_side(entry: dict[str, Any], mask: NDArray[Any]) -> NDArray[Any]:
    entry["image"] = {"left": "right", "right": "left"}[entry["image"]]
    return mask


def _category(entry: dict[str, Any], mask: NDArray[Any]) -> NDArray[Any]:
    entry["category_id"] = 1
    return mask


def _remove(folder: str) -> Callable[[Path], None]:
    return lambda root: sorted((root / folder).glob("*.*"))[0].unlink()


def _cut(folder: str) -> Callable[[Path], None]:
    def apply(root: Path) -> None:
        path = sorted((root / folder).glob("*.*"))[0]
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])

    return apply


def _plane_sideways(root: Path) -> None:
    for path in (root / "training" / "planes").glob("*.txt"):
        path.write_text("# Plane\nWidth 4\nHeight 1\n-1 0 0 1.65\n")


def _break(apply: Callable[[Path], None], *checks: str) -> Break:
    return Break(apply, frozenset(checks))


BREAKS: dict[str, Break] = {
    "left and right images swapped": _break(_images(lambda left, right: (right, left)), "images_swapped"),
    "right image of another place": _break(
        _images(lambda left, _: (left, np.random.default_rng(0).permuted(left[::-1], axis=1))),
        "different_scenes",
        "few_matches",
    ),
    "right image of other pixels": _break(
        _images(lambda left, right: (left, right[: right.shape[0] // 2])), "image_size"
    ),
    "right image turned by 0.3 degrees": _break(
        _images(lambda left, right: (left, _turned(right, 0.3))), "not_rectified"
    ),
    "baseline of the other sign": _break(_projections(_scale_baseline(-1.0)), "baseline_sign"),
    "baseline not times focal length": _break(_projections(_scale_baseline(1 / 720)), "baseline_length"),
    "box centre for bottom": _break(_boxes(_centre), "box_origin"),
    "order l w h": _break(_boxes(_order(2, 1, 0)), "box_order"),
    "2D boxes as x y width height": _break(_boxes(_corner_and_size), "box_2d"),
    "classes in lower case": _break(_boxes(_lower_case), "no_cars"),
    "masks of the other side": _break(_masks(_other_side), "masks_swapped"),
    "masks of another category": _break(_masks(_category), "no_masks"),
    "missing right image": _break(_remove("training/image_3"), "missing_files"),
    "missing calibration": _break(_remove("training/calib"), "missing_files"),
    "missing masks": _break(_remove("masks"), "missing_files"),
    "cut left image": _break(_cut("training/image_2"), "left_image"),
    "cut right image": _break(_cut("training/image_3"), "right_image"),
    "cut calibration": _break(_cut("training/calib"), "calibration_file"),
    "cut masks": _break(_cut("masks"), "mask_file"),
    "detections without the last columns": _break(_boxes(_cut_short), "detection_file"),
    "ground plane upright": _break(_plane_sideways, "plane_file"),
}
