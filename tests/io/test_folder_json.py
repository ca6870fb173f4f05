"""Wrong files of the plain folder layout give messages that name the mistake."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from directshape_torch.errors import DataFormatError
from directshape_torch.files.atomic_files import write_png
from directshape_torch.io.folder_files import read_frame, read_rig
from directshape_torch.io.instance_masks import MaskSizeError
from directshape_torch.io.kitti_calibration import camera_of_rig
from directshape_torch.io.layouts import folder_layout
from directshape_torch.io.mask_files import LayoutMasks

RIG: dict[str, Any] = {
    "schema_version": 1,
    "image_size_wh": [60, 40],
    "K_left": [[50, 0, 30], [0, 50, 20], [0, 0, 1]],
    "baseline_m": 0.5,
}
CAR: dict[str, Any] = {
    "class": "Car",
    "dimensions_hwl_m": [1.5, 1.6, 4],
    "bottom_center_m": [0, 1.5, 10],
    "rotation_y_rad": -1.6,
    "mask_left": "masks/a.png",
}
FRAME: dict[str, Any] = {"schema_version": 1, "objects": [CAR, {"class": "Person", "mask_left": None}]}


def changed(content: dict[str, Any], path: str, value: object) -> dict[str, Any]:
    """A copy with one entry replaced, or removed if the value is `...`."""
    content = copy.deepcopy(content)
    *parents, last = [int(word) if word.isdecimal() else word for word in path.split(".")]
    at: Any = content
    for word in parents:
        at = at[word]
    if value is ...:
        del at[last]
    else:
        at[last] = value
    return content


def write(root: Path, name: str, content: object) -> Path:
    path = root / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))
    return path


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for side in ("left", "right"):
        write_png(tmp_path / side / "a.png", np.zeros((40, 60, 3), np.uint8))
    mask = np.zeros((40, 60), np.uint8)
    mask[15:25, 20:40] = 200
    write_png(tmp_path / "masks" / "a.png", mask)
    write(tmp_path, "rig.json", RIG)
    write(tmp_path, "frames/a.json", FRAME)
    return tmp_path


def test_rig(root: Path) -> None:
    rig = read_rig(root / "rig.json")
    P2, P3 = rig.projections()
    assert list(rig.image_size_wh) == [60, 40]
    assert np.array_equal(P3[:, :3], P2[:, :3])
    calibration = folder_layout(root).files("a").read_calibration()
    # P3[0, 3] = -fx b.
    assert calibration.P3[0, 3] == -25.0
    assert not calibration.P2[:, 3].any()
    assert camera_of_rig(calibration, [], (60, 40)).K_left[0, 0, 0] == 50
    with pytest.raises(DataFormatError, match=r"rig\.json: is of images of 60 x 40 pixels, they have 40 x 60"):
        camera_of_rig(calibration, [], (40, 60))


def test_objects_become_lines_of_results(root: Path) -> None:
    car, person = folder_layout(root).files("a").read_objects()
    assert (car.hwl, car.location_ref, car.rotation_y, car.score) == ((1.5, 1.6, 4), (0, 1.5, 10), -1.6, 1.0)
    assert car.alpha == pytest.approx(-1.6)
    # Width 1.6 at 10 - 2 m in front: 50 * 0.8 / 8 = 5 px to each side, a little more as the car stands askew.
    assert car.box_2d[0] == pytest.approx(30 - 5, abs=0.6)
    assert car.box_2d[2] == pytest.approx(30 + 5, abs=0.6)
    assert not person.has_box_3d
    assert folder_layout(root).files("a").read_labels() is None


def test_masks_are_probabilities(root: Path) -> None:
    masks = LayoutMasks(folder_layout(root), None)
    (mask,) = masks.read("a", (40, 60))
    assert (mask.instance_id, mask.side, mask.is_car) == (0, "left", True)
    assert mask.probability.max() == pytest.approx(200 / 255)
    assert mask.mask_box == (20, 15, 39, 24)
    assert masks.files("a") == (root / "masks" / "a.png",)
    with pytest.raises(MaskSizeError, match="the soft mask has 60 x 40 pixels"):
        masks.read("a", (80, 60))


def test_plane_and_labels(root: Path) -> None:
    write(root, "frames/a.json", {**FRAME, "ground_plane": [0, 2, 0, -3], "labels": [CAR]})
    files = folder_layout(root).files("a")
    plane, labels = files.read_plane(), files.read_labels()
    assert plane.tolist() == [0, -1, 0, 1.5]
    assert labels[0].score is None
    write(root, "frames/a.json", {**FRAME, "ground_plane": [1, 0, 0, -3]})
    with pytest.raises(DataFormatError, match=r"the normal is not near the vertical.*docs/plain_folder\.md"):
        files.read_plane()
    write(root, "frames/a.json", FRAME)
    with pytest.raises(DataFormatError, match="holds no 'ground_plane'"):
        files.read_plane(needed=True)
    assert files.read_plane() is None


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("schema_version", 2, "'schema_version' is 2, expected 1"),
        ("baseline_m", ..., "either 'baseline_m' or 't_right_cam_m'"),
        ("t_right_cam_m", [-0.5, 0, 0], "either 'baseline_m' or 't_right_cam_m'"),
        ("baseline_m", "0.5", "baseline_m: expected float or nothing, got '0.5'"),
        ("K_left", [[50, 0, 30], [0, 50, 20]], "K_left: expected a list of 3"),
        ("K_left.0.0", 0, "'K_left' is no matrix"),
        ("K_right", "same", "K_right: expected a list of 3 or nothing, got 'same'"),
        ("image_size_wh", [60], "image_size_wh: expected a list of 2"),
        ("fx", 50, "'fx' is unknown"),
    ],
)
def test_damaged_rig(root: Path, path: str, value: object, message: str) -> None:
    with pytest.raises(DataFormatError, match=message):
        read_rig(write(root, "rig.json", changed({**RIG}, path, value)))


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("objects", ..., "'objects' is missing"),
        ("objects", {}, "objects: expected a list, got {}"),
        ("objects.0", "Car", r"objects\[0\] expected an object, got 'Car'"),
        ("objects.0.class", "a car", r"objects\[0\].class is 'a car', expected one word"),
        ("objects.0.rotation_y_rad", ..., r"objects\[0\]: a 3D box needs rotation_y_rad too"),
        ("objects.0.bottom_center_m", [0, 1], r"objects\[0\].bottom_center_m: expected a list of 3 or nothing"),
        ("objects.0.dimensions_hwl_m", [1, 0, 4], "expected lengths above 0"),
        ("objects.0.score", None, "score: expected float, got None"),
        ("objects.1.yaw", 1.0, r"objects\[1\].'yaw' is unknown"),
    ],
)
def test_damaged_frame(root: Path, path: str, value: object, message: str) -> None:
    with pytest.raises(DataFormatError, match=message):
        read_frame(write(root, "frames/a.json", changed(FRAME, path, value)))


def test_no_json(root: Path) -> None:
    (root / "frames" / "a.json").write_text("{")
    with pytest.raises(DataFormatError, match=r"a\.json: is not valid JSON"):
        read_frame(root / "frames" / "a.json")
    with pytest.raises(DataFormatError, match="is not a JSON object"):
        read_frame(write(root, "frames/b.json", []))
