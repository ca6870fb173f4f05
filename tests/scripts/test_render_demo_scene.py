"""The generator of demo frames is checked in conventions, layout, labels and files, and rendered if possible."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path

import numpy as np
import pytest
import render_demo_scene
import torch
from demo_scene import camera, frame_files, labels, layout, motion, surfaces

from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.io.layouts import tracking_layout

# pycocotools' decode predates numpy 2's protocol.
pytestmark = pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")
ASSET = Path(__file__).resolve().parents[2] / "directshape_torch" / "assets" / "demo"


@pytest.fixture(scope="module")
def scene() -> layout.SceneLayout:
    return layout.sample_layout(1, 6)


def test_camera_agrees_with_the_library() -> None:
    P2, P3 = (torch.from_numpy(camera.projection(name))[None] for name in ("P2", "P3"))
    rig = StereoCamera.from_projections(P2, P3)
    np.testing.assert_allclose(rig.T_right_cam[0, :3, 3].numpy(), camera.T_RIGHT_CAM, atol=1e-12)
    np.testing.assert_allclose(rig.t_cam_ref[0].numpy(), camera.T_CAM_REF, atol=1e-12)
    # (-339.5242 - 44.85728) / 721.5377 = -0.5327 m, and 2.7 mm vertically.
    np.testing.assert_allclose(camera.T_RIGHT_CAM[:2], [-0.53272, 0.00275], atol=2e-5)


@pytest.mark.parametrize("seed", range(3))
def test_cars_stand_apart_in_range_and_one_is_partly_hidden(seed: int) -> None:
    drawn = layout.sample_layout(seed)
    assert 4 <= len(drawn.cars) <= 6
    depths = np.array([car.T_road_obj[2, 3] for car in drawn.cars])
    assert depths.min() > 7.5
    assert depths.max() < 36.0
    centres = np.array([car.T_road_obj[[0, 2], 3] for car in drawn.cars])
    gaps = np.abs(centres[:, None] - centres[None])
    apart = (gaps[..., 0] > 2.0) | (gaps[..., 1] > 5.0) | np.eye(len(centres), dtype=bool)
    assert apart.all()
    shares = layout.visible_column_shares(drawn.camera, drawn.cars)
    assert shares.min() > 0.45
    assert shares.min() < 0.85


def test_label_of_a_known_box(scene: layout.SceneLayout) -> None:
    level = camera.CameraPose(1.65, 0.0, 0.0)
    car = layout.PlacedCar(scene.cars[0].parameters, layout.pose_on_road(2.0, 10.0, -0.5 * np.pi), (0.5, 0.5, 0.5), 0.0)
    # 4 x 1.8 x 1.5 m, its middle 0.1 m ahead of the object's origin: at z = 10.1 in the road frame.
    corners = layout.box_corners_obj(4.0, 1.8, 1.5) + np.array([0.1, 0.0, 0.0])
    label = labels.true_label(level, car, corners, visible_share=0.7)
    assert label.dimensions_hwl == pytest.approx((1.5, 1.8, 4.0))
    np.testing.assert_allclose(np.array(label.location_ref) + camera.T_CAM_REF, [2.0, 1.65, 10.1], atol=1e-12)
    assert label.rotation_y == pytest.approx(-0.5 * np.pi)
    assert label.alpha == pytest.approx(-0.5 * np.pi - np.arctan2(2.0, 10.1), abs=0.02)
    assert (label.occluded, label.truncated) == (1, 0.0)
    # The nearest face is at z = 8.1: it bounds the box at the right and below.
    assert label.box_2d[2] == pytest.approx(609.5593 + 721.5377 * 2.9 / 8.1)
    assert label.box_2d[3] == pytest.approx(172.854 + 721.5377 * 1.65 / 8.1)


@pytest.mark.parametrize("seed", [1, 2])
def test_cars_of_a_sequence_keep_their_shape_and_move(seed: int) -> None:
    layouts = motion.sample_sequence(seed, 8, 0.3)
    assert {tuple(car.parameters for car in each.cars) for each in layouts} == {
        tuple(car.parameters for car in layouts[0].cars)
    }
    assert layouts[-1].camera.z_m > layouts[0].camera.z_m + 1.0
    turned = [abs(_heading(layouts[-1].cars[k]) - _heading(layouts[0].cars[k])) for k in range(4)]
    moved = [
        np.linalg.norm(layouts[-1].cars[k].T_road_obj[:3, 3] - layouts[0].cars[k].T_road_obj[:3, 3]) for k in (0, 1)
    ]
    assert max(moved) > 5.0
    # Kinds 1 and 3 of the traffic turn.
    assert (max(turned) > 1.0) == (seed in (1, 3))


def _heading(car: layout.PlacedCar) -> float:
    return float(np.arctan2(-car.T_road_obj[2, 0], car.T_road_obj[0, 0]))


def test_a_sequence_has_the_files_of_the_tracking_benchmark(tmp_path: Path) -> None:
    blank, nothing = np.zeros((4, 6, 3), np.uint8), np.full((4, 6), -1)
    label = labels.CarLabel(0.0, 0, (1.0, 2.0, 3.0, 4.0), (1.5, 1.6, 3.9), (-1.0, 1.6, 10.0), 1.57)
    layouts = motion.sample_sequence(1, 2, 0.3)
    frames = [
        frame_files.Frame(each, blank, blank, nothing, nothing, {2: label, 5: label}, {2: label, 5: label})
        for each in layouts
    ]
    frame_files.write_sequence(tmp_path, "0001", frames, 0.3)
    found = tracking_layout(tmp_path, tmp_path / "detections" / "noisy_stereo")
    assert found.frame_ids() == ["0001_000000", "0001_000001"]
    assert [line.score for line in found.files("0001_000001").read_objects()] == [0.9, 0.9]
    assert len(found.files("0001_000001").read_labels() or []) == 2
    # `poses` leads from a frame's camera 0 to the first one's: the road's origin must arrive where it was.
    T_first_second = np.vstack(
        [np.loadtxt(tmp_path / "training" / "poses" / "0001.txt")[1].reshape(3, 4), [0, 0, 0, 1]]
    )
    origin = [camera.transform(each.camera.T_cam_road, np.zeros((1, 3))) - camera.T_CAM_REF for each in layouts]
    np.testing.assert_allclose(camera.transform(T_first_second, origin[1]), origin[0], atol=1e-9)


def test_bundled_labels_are_those_of_the_seed(scene: layout.SceneLayout) -> None:
    lines = (ASSET / "training/label_2/000000.txt").read_text().splitlines()
    for car, line in zip(scene.cars, lines, strict=True):
        T_cam_obj = scene.camera.T_cam_road @ car.T_road_obj
        location = np.array([float(x) for x in line.split()[11:14]])
        # The label's place is the middle of the mesh, the layout's the object's origin: they differ by centimetres.
        np.testing.assert_allclose(location + camera.T_CAM_REF, T_cam_obj[:3, 3], atol=0.08)


def test_bundled_masks_lie_in_the_projected_boxes() -> None:
    from pycocotools import mask as coco

    lines = (ASSET / "training/label_2/000000.txt").read_text().splitlines()
    for entry in json.loads((ASSET / "training/masks/000000.json").read_text()):
        if entry["image"] == "right":
            continue
        box = [float(x) for x in lines[entry["instance_id"] - 1001].split()[4:8]]
        v, u = np.nonzero(coco.decode(entry["segmentation"]))
        # The 2D box is the exact outline, so integer pixel centres inside the car cannot lie outside it.
        assert u.min() >= box[0] - 0.02
        assert v.min() >= box[1] - 0.02
        assert u.max() <= box[2] + 0.02
        assert v.max() <= box[3] + 0.02


def test_without_the_renderer_one_line_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    assert render_demo_scene.main(["--out", str(tmp_path / "frames")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith("pip install 'directshape_torch[render]'")
    assert not (tmp_path / "frames").exists()


@pytest.mark.skipif(importlib.util.find_spec("mitsuba") is None, reason="needs the extra `render` (mitsuba)")
def test_renderer_puts_pixel_centres_at_integers() -> None:
    from demo_scene.rendering import Renderer

    pose = camera.CameraPose(1.65, 0.01, 0.02)
    grey = surfaces.Material((0.5, 0.5, 0.5))
    road = surfaces.quad(np.array([-200.0, 0.0, 1.0]), np.array([400.0, 0, 0]), np.array([0, 0, 400.0]), grey)
    block = surfaces.box((-1.0, -1.5, 12.0), (1.0, 0.0, 14.0), grey)
    block = surfaces.Surface(block.vertices, block.faces, grey, instance=4)
    renderer = Renderer([road, block], None)
    u, v = np.meshgrid(np.arange(camera.IMAGE_WIDTH_PX), np.arange(camera.IMAGE_HEIGHT_PX))
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(camera.K).T
    for T_view_road in (pose.T_cam_road, pose.T_right_road):
        truth = renderer.pixel_truth(T_view_road)
        # Ground seen through pixel (u, v): depth = height / (ray . down), exactly.
        down = T_view_road[:3, 1]
        height_m = -down @ (-T_view_road[:3, 3])
        ground = (truth.instance == -1) & (truth.depth_m > 0) & (truth.depth_m < 60)
        expected = height_m / (rays @ down)
        disparity_error_px = camera.K[0, 0] * 0.5327 * (1 / truth.depth_m[ground] - 1 / expected[ground])
        assert ground.sum() > 100_000
        assert np.abs(disparity_error_px).max() < 0.02
        # The front face's outline, projected, bounds the mask to within one pixel centre.
        pixels = camera.project(camera.transform(T_view_road, block.vertices))
        v_mask, u_mask = np.nonzero(truth.instance == 4)
        low, high = pixels.min(axis=0), pixels.max(axis=0)
        assert [u_mask.min(), v_mask.min()] == list(np.ceil(low))
        assert [u_mask.max(), v_mask.max()] == list(np.floor(high))
