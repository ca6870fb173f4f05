"""A tiny data set in KITTI's layout is loaded, and damaged files are named."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from helpers.matched_masks import instances
from helpers.quick_runs import dataset

from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.files.atomic_files import write_png
from directshape_torch.geometry.disparity_field import DisparityField
from directshape_torch.io.frame_collation import collate
from directshape_torch.io.kitti_labels import read_objects
from directshape_torch.io.stereo_dataset import open_dataset

# The pedestrian's line of the data set has this 2D box.
WALKER_BOX = (1, 20, 9, 60)
PLANE = "# Plane\nWidth 4\nHeight 1\n0 -1 0 {}\n"


@pytest.fixture
def root(kitti_copy: Path) -> Path:
    """Two cars, and a pedestrian between their lines, in each of three frames."""
    return kitti_copy


def read_masks(root: Path) -> list[dict[str, Any]]:
    return list(json.loads((root / "masks" / "000000.json").read_text()))


def write_masks(root: Path, entries: list[dict[str, Any]]) -> None:
    (root / "masks" / "000000.json").write_text(json.dumps(entries))


def instance(side: str, box: tuple[float, ...], number: int, category: int = 3) -> dict[str, Any]:
    u0, v0, u1, v1 = box
    polygon = [u0, v0, u1 + 1, v0, u1 + 1, v1 + 1, u0, v1 + 1]
    return {"image": side, "instance_id": number, "category_id": category, "segmentation": [polygon]}


def test_frame_and_detections(root: Path) -> None:
    path = root / "detections" / "data" / "000000.txt"
    path.write_text(path.read_text() + "Car -1 -1 -10 1 2 3 4 -1 -1 -1 -1000 -1000 -1000 -10 0.3\n")
    loaded = dataset(root, dtype=torch.float64).load("000000")
    assert loaded.frame_id == "000000"
    assert loaded.frame.images_left.shape == (1, 3, 120, 160)
    assert loaded.frame.sizes.tolist() == [[120, 160]]
    # Two of four lines are cars with a 3D box, in the order of the lines.
    assert loaded.refined_rows == (0, -1, 1, -1)
    assert loaded.row_of_detection == (0, 2)
    cars = [line for line in read_objects(path) if line.type == "Car" and line.has_box_3d]
    expected = torch.tensor([car.location_ref for car in cars]).double() + loaded.frame.camera.t_cam_ref[0]
    torch.testing.assert_close(loaded.detections.T_cam_obj[:, :3, 3], expected, atol=1e-6, rtol=0)
    assert loaded.detections.score.tolist() == [0.9, 0.8]
    assert loaded.labels[0].score is None
    assert dataset(root, classes=("Pedestrian",)).load("000000").refined_rows == (-1, 0, -1, -1)


def test_image_channels_are_rgb(root: Path) -> None:
    red = np.zeros((120, 160, 3), np.uint8)
    red[..., 0] = 255
    write_png(root / "training" / "image_2" / "000000.png", red)
    image = dataset(root).load("000000").frame.images_left
    assert image.mean(dim=(0, 2, 3)).tolist() == [1.0, 0.0, 0.0]


def test_masks_are_matched_by_geometry_whatever_the_ids_say(root: Path) -> None:
    entries = read_masks(root)
    for entry in entries:
        # The ids of the two images do not agree.
        entry["instance_id"] = 5 + entry["instance_id"] if entry["image"] == "left" else 8 - entry["instance_id"]
    write_masks(root, entries)
    assert instances(dataset(root), dataset(root).load("000000")) == ([5, 6], [8, 7])


def test_a_mask_in_one_image_only_and_none_at_all(root: Path) -> None:
    write_masks(root, [m for m in read_masks(root) if (m["image"] == "left") == (m["instance_id"] == 1)])
    detections = dataset(root).load("000000").detections
    assert detections.has_mask_left.tolist() == [False, True]
    assert detections.has_mask_right.tolist() == [True, False]
    assert detections.mask_left[0].sum() == 0
    without = open_dataset("kitti", root, root / "detections").load("000000").detections
    assert not without.has_mask_left.any()
    assert not without.has_mask_right.any()


def test_other_instances_are_occluders_with_the_depth_of_a_detection_of_their_class(root: Path) -> None:
    write_masks(root, [*read_masks(root), instance("left", WALKER_BOX, 7, category=1)])
    occluders = dataset(root).load("000000").detections.occluders
    assert occluders.mask_left.dense().shape == (1, 120, 160)
    assert occluders.mask_left.dense()[0, 30, 8] == 1
    assert occluders.mask_right.dense().sum() == 0
    assert occluders.bottom_v.tolist() == [60.0]
    assert occluders.depth_m.tolist() == pytest.approx([9.003])
    path = root / "detections" / "data" / "000000.txt"
    path.write_text("".join(line for line in path.read_text().splitlines(keepends=True) if "Pedestrian" not in line))
    occluders = dataset(root).load("000000").detections.occluders
    assert occluders.depth_m.isnan().all()


def test_left_over_car_mask_takes_its_depth_from_a_van(root: Path) -> None:
    path = root / "detections" / "data" / "000000.txt"
    path.write_text(path.read_text().replace("Car", "Van", 1))
    detections = dataset(root).load("000000").detections
    assert len(detections) == 1
    van = read_objects(path)[0].location_ref[2] + 0.003
    # In the left and in the right image.
    assert detections.occluders.depth_m.tolist() == pytest.approx([van, van])


def fake_estimator(monkeypatch: pytest.MonkeyPatch, answer: object) -> None:
    monkeypatch.setattr("directshape_torch.io.stereo_dataset.estimate_ground_plane", lambda *_: answer)


def test_ground_of_the_file_of_stereo_or_of_the_camera_height(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = root / "training" / "planes" / "000000.txt"
    path.write_text(PLANE.format(1.7))
    in_file = dataset(root, dtype=torch.float64).load("000000")
    assert in_file.frame.ground.source == ("file",)
    # n = (0, -1, 0), so d_cam = d_ref + t_y.
    assert in_file.frame.ground.offset.item() == pytest.approx(1.7 + in_file.frame.camera.t_cam_ref[0, 1].item())
    fake_estimator(monkeypatch, (torch.tensor([0.0, -1.0, 0.0]), torch.tensor(1.8)))
    assert dataset(root, ground="stereo").load("000000").frame.ground.source == ("stereo",)
    assert dataset(root, ground="camera_height").load("000000").frame.ground.source == ("camera_height",)
    with pytest.raises(InputError, match="ground: expected one of auto, file, stereo, camera_height, got 'lidar'"):
        dataset(root, ground="lidar")
    path.unlink()
    with pytest.raises(DataFormatError, match=r"planes/000000\.txt: cannot be read"):
        dataset(root, ground="file").load("000000")
    found = dataset(root).load("000000").frame.ground
    assert found.source == ("stereo",)
    assert found.offset.tolist() == pytest.approx([1.8])
    fake_estimator(monkeypatch, None)
    found = dataset(root, camera_height_m=1.5).load("000000").frame.ground
    assert found.source == ("camera_height",)
    assert found.offset.tolist() == [1.5]


def test_frames_split_and_order(root: Path) -> None:
    assert dataset(root).frame_ids == ("000000", "000001", "000002")
    assert dataset(root, frames=["000002", 0, 2]).frame_ids == ("000002", "000000")
    split = root / "val.txt"
    split.write_text("000002\n000000\n\n000002\n")
    assert dataset(root, split=split).frame_ids == ("000002", "000000")
    assert len(dataset(root, split=split, frames=["000000"])) == 1
    with pytest.raises(InputError, match=r"frames: expected ids that occur in .*val\.txt, such as 000002, got 4"):
        dataset(root, split=split, frames=[4])


def cut(path: Path) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 5])


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (
            lambda root: cut(root / "training/image_3/000000.png"),
            r"image_3/000000\.png: cannot be read as a whole image",
        ),
        (lambda root: (root / "training/image_2/000000.png").unlink(), r"image_2/000000\.png: cannot be read"),
        (lambda root: (root / "training/calib/000000.txt").write_text("P2: 1\n"), r"calib/000000\.txt, line 1: exp"),
        (lambda root: cut(root / "detections/data/000000.txt"), r"000000\.txt, line 1: expected 15 or 16 columns"),
        (lambda root: cut(root / "training/label_2/000000.txt"), r"label_2/000000\.txt, line 1: expected 15 columns"),
        (lambda root: (root / "masks/000000.json").unlink(), r"masks/000000\.json: cannot be read"),
        (
            lambda root: write_png(root / "training/image_3/000000.png", np.zeros((120, 100, 3), np.uint8)),
            r"image_3/000000\.png: has 100 x 120 pixels, the left image 160 x 120",
        ),
    ],
)
def test_damage_names_the_file_and_spares_other_frames(root: Path, damage: Any, message: str) -> None:
    damage(root)
    frames = dataset(root)
    with pytest.raises(DataFormatError, match=message):
        frames.load("000000")
    assert frames.load("000001").frame_id == "000001"


def test_input_files_are_those_that_load_reads(root: Path) -> None:
    files = dataset(root).input_files("000000")
    assert set(files) == {"image_left", "image_right", "calibration", "detections", "ground_plane", "masks_0"}
    assert all(path.is_file() for path in files.values())
    assert "ground_plane" not in dataset(root, ground="camera_height").input_files("000000")


def test_collate_pads_and_numbers(root: Path) -> None:
    for folder in ("image_2", "image_3"):
        path = str(root / "training" / folder / "000001.png")
        cv2.imwrite(path, cv2.copyMakeBorder(cv2.imread(path), 0, 6, 0, 10, cv2.BORDER_REPLICATE))
    (root / "masks" / "000001.json").write_text("[]")
    (root / "training" / "planes" / "000001.txt").write_text(PLANE.format(1.5))
    write_masks(root, [*read_masks(root), instance("left", WALKER_BOX, 7, category=1)])
    loaded = [dataset(root).load(frame_id) for frame_id in ("000000", "000001")]
    frame, detections = collate(loaded)
    assert frame.frame_ids == ("000000", "000001")
    assert frame.images_left.shape == (2, 3, 126, 170)
    assert frame.sizes.tolist() == [[120, 160], [126, 170]]
    assert torch.equal(frame.images_left[0, :, :120, :160], loaded[0].frame.images_left[0])
    assert frame.images_left[0, :, 120:].abs().sum() == 0
    assert frame.ground.source == ("file", "file")
    assert frame.ground.offset.tolist() == [item.frame.ground.offset.item() for item in loaded]
    assert detections.frame_index.tolist() == [0, 0, 1, 1]
    assert detections.mask_left.dense().shape == (4, 126, 170)
    assert torch.equal(detections.mask_left.dense()[:2, :120, :160], loaded[0].detections.mask_left.dense())
    assert detections.has_mask_left.tolist() == [True, True, False, False]
    assert detections.occluders.frame_index.tolist() == [0]


def test_collate_keeps_standard_deviations_and_what_no_frame_knows_is_infinite(root: Path) -> None:
    loaded = dataset(root).load("000000")
    count = len(loaded.detections)
    sigma = torch.rand(count, 4) + 0.1
    known = replace(loaded, detections=replace(loaded.detections, pose_sigma=sigma))
    joined = collate([known, loaded])[1].pose_sigma
    assert torch.equal(joined, torch.cat([sigma, torch.full((count, 4), torch.inf)]))
    assert collate([loaded, loaded])[1].pose_sigma is None


def test_collate_gives_every_car_as_many_other_poses_as_the_one_with_most(root: Path) -> None:
    loaded = dataset(root).load("000000")
    poses = loaded.detections.T_cam_obj[:, None]
    one, two = (
        replace(loaded, detections=replace(loaded.detections, other_T_cam_obj=poses.repeat(1, n, 1, 1))) for n in (1, 2)
    )
    joined = collate([one, loaded, two])[1].other_T_cam_obj
    count = len(poses)
    assert joined.isfinite().flatten(2).all(dim=2).sum(dim=1).tolist() == [*[1] * count, *[0] * count, *[2] * count]
    assert torch.equal(joined[-count:, 1], poses[:, 0])
    assert collate([loaded, loaded])[1].other_T_cam_obj is None


def test_collate_compares_all_of_the_fields(root: Path) -> None:
    camera = dataset(root).load("000000").frame.camera
    field = DisparityField.constant(-0.5, (160, 120), camera.K_left[0], camera.K_right[0], camera.T_right_cam[0])
    loaded = dataset(root, disparity_field=field).load("000000")
    for name in ("coefficients", "vertical_coefficients", "hull_uv", "K_left"):
        equal = replace(field, **{name: getattr(field, name).clone()})
        other = replace(field, **{name: getattr(field, name) + 0.01})
        assert len(collate([loaded, dataset(root, disparity_field=equal).load("000001")])[0]) == 2
        with pytest.raises(InputError, match="frames with the same residual disparity field"):
            collate([loaded, dataset(root, disparity_field=other).load("000001")])
