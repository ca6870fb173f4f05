"""A tiny data set in KITTI's layout: what is loaded, from where, and what is said about damaged files."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.matched_masks import instances

from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.files.atomic_files import write_png
from directshape_torch.geometry.box3d import pose_from_kitti
from directshape_torch.geometry.disparity_field import DisparityField
from directshape_torch.geometry.image_boxes import project_boxes
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.io.frame_collation import collate
from directshape_torch.io.stereo_dataset import StereoDataset, open_dataset

P2 = torch.tensor([[500.0, 0, 60, 30], [0, 500, 30, 0], [0, 0, 1, 0.003]], dtype=torch.float64)
P3 = torch.tensor([[500.0, 0, 60, -220], [0, 500, 30, 2], [0, 0, 1, 0.003]], dtype=torch.float64)
CAMERA = StereoCamera.from_projections(P2[None], P3[None])
CARS = {"near": (0.2, 1.0, 20.0), "far": (2.5, 1.0, 30.0)}  # bottom centres in ref
PLANE = "# Plane\nWidth 4\nHeight 1\n0 -1 0 1.65\n"


def boxes(location: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    pose = pose_from_kitti(torch.tensor([location]).double() + CAMERA.t_cam_ref, torch.full((1,), -1.5).double())
    left, right = project_boxes(pose, torch.tensor([[1.5, 1.6, 3.9]]), CAMERA, (64, 120))
    return left[0], right[0]


def line(kind: str, location: tuple[float, float, float], score: float) -> str:
    box = " ".join(f"{value:.2f}" for value in boxes(location)[0])
    return f"{kind} -1 -1 0 {box} 1.5 1.6 3.9 {location[0]} {location[1]} {location[2]} -1.5 {score}"


def instance(side: str, box: np.ndarray, number: int, category: int = 3) -> dict[str, Any]:
    u0, v0, u1, v1 = box.tolist()
    polygon = [u0, v0, u1 + 1, v0, u1 + 1, v1 + 1, u0, v1 + 1]
    return {"image": side, "instance_id": number, "category_id": category, "segmentation": [polygon]}


def masks() -> list[dict[str, Any]]:
    near, far = boxes(CARS["near"]), boxes(CARS["far"])
    walker = np.array([5.0, 20, 12, 45])
    # The ids of the two images do not agree.
    return [
        instance("left", near[0], 1),
        instance("left", far[0], 2),
        instance("left", walker, 3, category=1),
        instance("right", far[1], 1),
        instance("right", near[1], 2),
    ]


def write_frame(root: Path, frame_id: str, size_hw: tuple[int, int] = (64, 120)) -> None:
    random = np.random.default_rng(int(frame_id))
    for folder in ("image_2", "image_3"):
        write_png(root / "training" / folder / f"{frame_id}.png", random.integers(0, 256, (*size_hw, 3), np.uint8))
    calibration = "".join(
        f"{name}: {' '.join(str(value) for value in P.flatten().tolist())}\n" for name, P in (("P2", P2), ("P3", P3))
    )
    texts = {
        f"training/calib/{frame_id}.txt": calibration,
        f"training/planes/{frame_id}.txt": PLANE,
        f"training/label_2/{frame_id}.txt": line("Car", CARS["near"], 0).rsplit(" ", 1)[0] + "\n",
        f"detections/data/{frame_id}.txt": "\n".join(
            [
                line("Car", CARS["far"], 0.5),
                line("Pedestrian", (0.0, 1.0, 9.0), 0.4),
                "Car -1 -1 -10 1 2 3 4 -1 -1 -1 -1000 -1000 -1000 -10 0.3",
                line("Car", CARS["near"], 0.9),
            ]
        ),
        f"masks/{frame_id}.json": json.dumps(masks()),
    }
    for name, text in texts.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_frame(tmp_path, "000000")
    write_frame(tmp_path, "000003")
    return tmp_path


def dataset(root: Path, **options: Any) -> StereoDataset:
    return open_dataset("kitti", root, root / "detections", root / "masks", **options)


def test_frame_and_detections(root: Path) -> None:
    loaded = dataset(root, dtype=torch.float64).load("000000")
    assert loaded.frame_id == "000000"
    assert loaded.frame.images_left.shape == (1, 3, 64, 120)
    assert 0 <= loaded.frame.images_left.min() < 0.05
    assert 0.95 < loaded.frame.images_left.max() <= 1
    assert loaded.frame.sizes.tolist() == [[64, 120]]
    torch.testing.assert_close(loaded.frame.camera.T_right_cam, CAMERA.T_right_cam)
    # Two of four lines are cars with a 3D box, in the order of the lines.
    assert loaded.refined_rows == (0, -1, -1, 1)
    assert loaded.row_of_detection == (0, 3)
    assert [o.type for o in loaded.input_objects] == ["Car", "Pedestrian", "Car", "Car"]
    expected = torch.tensor([CARS["far"], CARS["near"]]).double() + CAMERA.t_cam_ref
    torch.testing.assert_close(loaded.detections.T_cam_obj[:, :3, 3], expected, atol=1e-6, rtol=0)
    assert loaded.detections.score.tolist() == [0.5, 0.9]
    assert loaded.labels is not None
    assert loaded.labels[0].score is None


def test_image_channels_are_rgb(root: Path) -> None:
    red = np.zeros((64, 120, 3), np.uint8)
    red[..., 0] = 255
    write_png(root / "training" / "image_2" / "000000.png", red)
    image = dataset(root).load("000000").frame.images_left
    assert image.mean(dim=(0, 2, 3)).tolist() == [1.0, 0.0, 0.0]


def test_masks_are_matched_by_geometry_whatever_the_ids_say(root: Path) -> None:
    assert instances(dataset(root), dataset(root).load("000000")) == ([2, 1], [1, 2])
    loaded = dataset(root).load("000000")
    assert loaded.detections.has_mask_left.tolist() == [True, True]
    assert loaded.detections.has_mask_right.tolist() == [True, True]
    u0, v0, u1, v1 = boxes(CARS["near"])[1].round().astype(int)
    inside = loaded.detections.mask_right[1, v0 + 1 : v1, u0 + 1 : u1]
    assert inside.min() == 1.0
    assert loaded.detections.mask_right[1].sum() == pytest.approx(inside.numel(), rel=0.4)


def test_a_mask_in_one_image_only_and_none_at_all(root: Path) -> None:
    (root / "masks" / "000000.json").write_text(json.dumps([masks()[0], masks()[3]]))
    detections = dataset(root).load("000000").detections
    assert detections.has_mask_left.tolist() == [False, True]
    assert detections.has_mask_right.tolist() == [True, False]
    assert detections.mask_left[0].sum() == 0
    without = open_dataset("kitti", root, root / "detections").load("000000").detections
    assert not without.has_mask_left.any()
    assert not without.has_mask_right.any()


def test_right_mask_of_a_hidden_car_is_found_by_way_of_the_left_one(root: Path) -> None:
    """A quarter of the car shows in both images: too little for its projected box, but the same part in both."""
    left, right = boxes(CARS["near"])
    quarter_left, quarter_right = left.copy(), right.copy()
    quarter_left[2] = left[0] + 0.25 * (left[2] - left[0])
    quarter_right[2] = right[0] + 0.25 * (right[2] - right[0])
    seen_left = instance("left", quarter_left, 1)
    seen_left["bbox"] = [left[0], left[1], left[2] - left[0] + 1, left[3] - left[1] + 1]
    path = root / "masks" / "000000.json"
    path.write_text(json.dumps([seen_left, instance("right", quarter_right, 9)]))
    assert instances(dataset(root), dataset(root).load("000000")) == ([-1, 1], [-1, 9])
    path.write_text(json.dumps([instance("right", quarter_right, 9)]))
    assert instances(dataset(root), dataset(root).load("000000"))[1] == [-1, -1]


def test_other_instances_are_occluders(root: Path) -> None:
    occluders = dataset(root).load("000000").detections.occluders
    assert occluders is not None
    assert occluders.mask_left.shape == (1, 64, 120)
    assert occluders.mask_left[0, 30, 8] == 1
    assert occluders.mask_right.sum() == 0
    assert occluders.bottom_v.tolist() == [45.0]
    assert occluders.depth_m.isnan().all()


def test_occluder_with_a_detection_of_its_class_has_a_depth(root: Path) -> None:
    walker = line("Pedestrian", (0.0, 1.0, 9.0), 0.4).split()
    walker[4:8] = ["5", "20", "12", "45"]
    path = root / "detections" / "data" / "000000.txt"
    path.write_text(path.read_text() + "\n" + " ".join(walker))
    occluders = dataset(root).load("000000").detections.occluders
    assert occluders is not None
    assert occluders.depth_m.tolist() == pytest.approx([9.003])


def test_left_over_car_mask_takes_its_depth_from_a_van(root: Path) -> None:
    path = root / "detections" / "data" / "000000.txt"
    path.write_text(path.read_text().replace("Car -1 -1 0", "Van -1 -1 0", 1))
    detections = dataset(root).load("000000").detections
    assert len(detections) == 1
    assert detections.occluders is not None
    depths = detections.occluders.depth_m.tolist()
    assert sorted(depth for depth in depths if depth == depth) == pytest.approx([30.003, 30.003])
    assert len(depths) == 3


def test_classes_to_refine_are_a_choice(root: Path) -> None:
    assert dataset(root, classes=("Pedestrian",)).load("000000").refined_rows == (-1, 0, -1, -1)


def fake_estimator(monkeypatch: pytest.MonkeyPatch, answer: object) -> None:
    monkeypatch.setattr("directshape_torch.io.stereo_dataset.estimate_ground_plane", lambda *_: answer)


def test_ground_of_the_file_of_stereo_or_of_the_camera_height(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    in_file = dataset(root, dtype=torch.float64).load("000000").frame.ground
    assert in_file.source == ("file",)
    # n = (0, -1, 0), so d_cam = 1.65 + t_y, t_y = (0 - 30 * 0.003) / 500.
    assert in_file.offset.item() == pytest.approx(1.65 - 30 * 0.003 / 500, abs=1e-12)
    fake_estimator(monkeypatch, (torch.tensor([0.0, -1.0, 0.0]), torch.tensor(1.7)))
    assert dataset(root, ground="stereo").load("000000").frame.ground.source == ("stereo",)
    assert dataset(root, ground="camera_height").load("000000").frame.ground.source == ("camera_height",)
    with pytest.raises(InputError, match="ground: expected one of auto, file, stereo, camera_height, got 'lidar'"):
        dataset(root, ground="lidar")
    (root / "training" / "planes" / "000000.txt").unlink()
    with pytest.raises(DataFormatError, match=r"planes/000000\.txt: cannot be read"):
        dataset(root, ground="file").load("000000")
    found = dataset(root).load("000000").frame.ground
    assert found.source == ("stereo",)
    assert found.offset.tolist() == pytest.approx([1.7])
    fake_estimator(monkeypatch, None)
    found = dataset(root, camera_height_m=1.5).load("000000").frame.ground
    assert found.source == ("camera_height",)
    assert found.offset.tolist() == [1.5]


def test_frames_split_and_order(root: Path) -> None:
    assert dataset(root).frame_ids == ("000000", "000003")
    assert dataset(root, frames=[3]).frame_ids == ("000003",)
    assert dataset(root, frames=["000003", 0, 3]).frame_ids == ("000003", "000000")
    split = root / "val.txt"
    split.write_text("000003\n000000\n\n000003\n")
    assert dataset(root, split=split).frame_ids == ("000003", "000000")
    assert len(dataset(root, split=split, frames=["000000"])) == 1
    with pytest.raises(InputError, match=r"frames: expected ids that occur in .*val\.txt, got 000004"):
        dataset(root, split=split, frames=[4])


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda root: cut(root / "training/image_3/000000.png"), r"image_3/000000\.png: PNG is cut short"),
        (lambda root: (root / "training/image_2/000000.png").unlink(), r"image_2/000000\.png: cannot be read"),
        (lambda root: (root / "training/calib/000000.txt").write_text("P2: 1\n"), r"calib/000000\.txt, line 1: exp"),
        (lambda root: cut(root / "detections/data/000000.txt"), r"000000\.txt, line 2: expected 15 or 16 columns"),
        (lambda root: (root / "masks/000000.json").unlink(), r"masks/000000\.json: cannot be read"),
        (
            lambda root: write_png(root / "training/image_3/000000.png", np.zeros((64, 100, 3), np.uint8)),
            r"image_3/000000\.png: has 100 x 64 pixels, the left image 120 x 64",
        ),
    ],
)
def test_damage_names_the_file_and_spares_other_frames(root: Path, damage: Any, message: str) -> None:
    damage(root)
    frames = dataset(root)
    with pytest.raises(DataFormatError, match=message):
        frames.load("000000")
    assert frames.load("000003").frame_id == "000003"


def cut(path: Path) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * 0.35)])


def test_input_files_are_those_that_load_reads(root: Path) -> None:
    files = dataset(root).input_files("000000")
    assert set(files) == {"image_left", "image_right", "calibration", "detections", "ground_plane", "masks_0"}
    assert all(path.is_file() for path in files.values())
    assert "ground_plane" not in dataset(root, ground="camera_height").input_files("000000")


def test_collate_pads_and_numbers(root: Path) -> None:
    write_frame(root, "000005", (70, 130))
    (root / "masks" / "000005.json").write_text("[]")
    (root / "training" / "planes" / "000005.txt").write_text(PLANE.replace("1.65", "1.5"))
    frames = dataset(root)
    loaded = [frames.load(frame_id) for frame_id in ("000003", "000005")]
    frame, detections = collate(loaded)
    assert frame.frame_ids == ("000003", "000005")
    assert frame.images_left.shape == (2, 3, 70, 130)
    assert frame.sizes.tolist() == [[64, 120], [70, 130]]
    assert torch.equal(frame.images_left[0, :, :64, :120], loaded[0].frame.images_left[0])
    assert frame.images_left[0, :, 64:].abs().sum() == 0
    assert frame.ground.source == ("file", "file")
    assert frame.ground.offset.tolist() == pytest.approx([1.65 - 0.00018, 1.5 - 0.00018])
    assert detections.frame_index.tolist() == [0, 0, 1, 1]
    assert detections.mask_left.shape == (4, 70, 130)
    assert torch.equal(detections.mask_left[:2, :64, :120], loaded[0].detections.mask_left)
    assert detections.has_mask_left.tolist() == [True, True, False, False]
    assert detections.occluders is not None
    assert detections.occluders.frame_index.tolist() == [0]


def test_collate_keeps_standard_deviations_and_what_no_frame_knows_is_infinite(root: Path) -> None:
    loaded = dataset(root).load("000003")
    count = len(loaded.detections)
    sigma = torch.rand(count, 4) + 0.1
    known = replace(loaded, detections=replace(loaded.detections, pose_sigma=sigma))
    joined = collate([known, loaded])[1].pose_sigma
    assert joined is not None
    assert torch.equal(joined, torch.cat([sigma, torch.full((count, 4), torch.inf)]))
    assert collate([loaded, loaded])[1].pose_sigma is None


@pytest.mark.parametrize("name", ["coefficients", "vertical_coefficients", "hull_uv", "K_left"])
def test_collate_compares_all_of_the_fields(root: Path, name: str) -> None:
    field = DisparityField.constant(-0.5, (120, 64), CAMERA.K_left[0], CAMERA.K_right[0], CAMERA.T_right_cam[0])
    equal = replace(field, **{name: getattr(field, name).clone()})
    other = replace(field, **{name: getattr(field, name) + 0.01})
    loaded = dataset(root, disparity_field=field).load("000000")
    assert len(collate([loaded, dataset(root, disparity_field=equal).load("000003")])[0]) == 2
    with pytest.raises(InputError, match="frames with the same residual disparity field"):
        collate([loaded, dataset(root, disparity_field=other).load("000003")])
