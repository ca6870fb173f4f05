"""Shapes are fitted to points on surfaces of known cars, from one side and from all, in the frame of a LiDAR."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from directshape_torch import InputError, PCAShapePrior, ShapeFit, Status, fit_shape
from directshape_torch.cli.fit_shape import fit_scan
from directshape_torch.cli.main import main
from directshape_torch.geometry import se3
from directshape_torch.geometry.box_formats import boxes_to_poses, poses_to_boxes
from directshape_torch.io.kitti_labels import read_objects
from directshape_torch.io.stereo_dataset import open_dataset
from directshape_torch.shape.zero_level import sdf_to_mesh, zero_level_extents

PRIOR = PCAShapePrior.load_bundled().double()
CODE = torch.tensor([[1.0, -0.8, 0.5, 0.0, 0.3, 0.0, 0.0, 0.0]], dtype=torch.float64)
LOWER, UPPER = zero_level_extents(PRIOR.values(CODE), PRIOR.origin, PRIOR.spacing_m)[0]
LENGTH, HEIGHT, WIDTH = (UPPER - LOWER).tolist()
# In the frame of a LiDAR, one ahead, one behind.
TRUE_BOXES = torch.tensor(
    [[12.0, 3.0, -1.7, LENGTH, WIDTH, HEIGHT, 0.4], [-9.0, -2.0, -1.6, LENGTH, WIDTH, HEIGHT, 2.8]], dtype=torch.float64
)
ERRORS = torch.tensor([[0.3, -0.15, 0.05, 0.2, 0.1, 0.05, 0.08], [-0.2, 0.2, -0.04, -0.3, 0.0, 0.1, -0.1]]).double()


def cars(seen_from_sensor: bool) -> tuple[Tensor, Tensor]:
    """Points of both cars (P, 3), 400 each, and their poses in the frame of the points."""
    T, _ = boxes_to_poses(TRUE_BOXES, "mmdet3d_lidar", torch.eye(4).double())
    mesh = sdf_to_mesh(PRIOR.values(CODE)[0], PRIOR.origin, PRIOR.spacing_m)
    random = np.random.default_rng(0)
    clouds = []
    for pose in T:
        weights = random.dirichlet((1, 1, 1), 4000)
        face = random.choice(len(mesh.faces), 4000, p=mesh.area_faces / mesh.area)
        at = torch.from_numpy((weights[:, :, None] * mesh.vertices[mesh.faces[face]]).sum(1))
        normal = torch.from_numpy(mesh.face_normals[face].copy()) @ pose[:3, :3].T
        points = se3.transform(pose, at)
        keep = (normal * points).sum(1) < 0 if seen_from_sensor else torch.ones(4000, dtype=torch.bool)
        clouds.append(points[keep][:400] + 0.02 * torch.from_numpy(random.standard_normal((int(keep.sum()), 3)))[:400])
    return torch.cat(clouds), T


def fitted(seen_from_sensor: bool) -> tuple[ShapeFit, Tensor]:
    points, T = cars(seen_from_sensor)
    return fit_shape(points, TRUE_BOXES + ERRORS, "mmdet3d_lidar", PRIOR), T


@pytest.mark.parametrize(("seen_from_sensor", "limit_m"), [(False, 0.06), (True, 0.12)])
def test_poses_come_back(seen_from_sensor: bool, limit_m: float) -> None:
    fit, T = fitted(seen_from_sensor)
    assert all(status.is_refined for status in fit.cars.status)
    # Of the boxes around the shapes: where in a car its origin is, no point says.
    true = replace(fit.cars, T_cam_obj=T, code=CODE.expand(2, -1)).to_boxes(T_cam_boxes=torch.eye(4).double())
    found = fit.cars.to_boxes(T_cam_boxes=torch.eye(4).double())
    error = (found - true)[:, :2].norm(dim=1)
    assert (error < limit_m).all(), error
    assert (fit.distance_after_m < 0.035).all()
    assert (fit.distance_after_m < 0.5 * fit.distance_before_m).all()
    yaw = torch.atan2(fit.cars.T_cam_obj[:, 1, 0], fit.cars.T_cam_obj[:, 0, 0])
    assert yaw.tolist() == pytest.approx(TRUE_BOXES[:, 6].tolist(), abs=0.03)


def test_meshes_and_boxes_stand_where_the_points_are() -> None:
    fit, _ = fitted(False)
    boxes = fit.cars.to_boxes("mmdet3d_lidar", T_cam_boxes=torch.eye(4).double())
    # The mean height of a surface above its ground is that of no box: only what lies along the ground is compared.
    assert boxes[:, :2].tolist() == pytest.approx(TRUE_BOXES[:, :2].numpy(), abs=0.15)
    for mesh, box in zip(fit.cars.meshes(), boxes, strict=True):
        assert mesh.bounds[0, 2] == pytest.approx(float(box[2]), abs=0.05)
        assert mesh.is_watertight


def test_standard_deviations_are_in_the_frame_of_the_points_and_no_mask_is_judged() -> None:
    points, _ = cars(True)
    quarter = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    boxes = TRUE_BOXES + ERRORS
    turned = torch.cat([boxes[:, :3] @ quarter.T, boxes[:, 3:6], boxes[:, 6:] + torch.pi / 2], dim=1)
    one = fit_shape(points, boxes, "mmdet3d_lidar", PRIOR).cars
    other = fit_shape(points @ quarter.T, turned, "mmdet3d_lidar", PRIOR).cars
    expected = quarter @ one.covariance_xyz_yaw[:, :3, :3] @ quarter.T
    torch.testing.assert_close(other.covariance_xyz_yaw[:, :3, :3], expected, atol=1e-9, rtol=1e-4)
    # x forward, y left, z up as z, -x, -y of a camera, in which headings turn the other way.
    camera = torch.tensor([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]], dtype=torch.float64)
    kitti = torch.cat([boxes[:, :3] @ camera.T, boxes[:, [5, 4, 3]], -boxes[:, 6:] - torch.pi / 2], dim=1)
    in_camera = fit_shape(points @ camera.T, kitti, "kitti", PRIOR).cars
    J = torch.block_diag(camera, -torch.ones(1, 1, dtype=torch.float64))
    expected = J @ one.covariance_xyz_yaw @ J.T
    torch.testing.assert_close(in_camera.covariance_xyz_yaw, expected, atol=1e-9, rtol=1e-4)
    assert one.quality.mask_iou_left.isnan().all()


def test_points_alone_say_where_the_car_is() -> None:
    points, _ = cars(True)
    beside = torch.tensor([[0.0, 0.3, 0.0, 0.0, 0.0, 0.0, 0.0]])
    right, wrong = (fit_shape(points, TRUE_BOXES + off, "mmdet3d_lidar", PRIOR) for off in (0 * beside, beside))
    assert (wrong.distance_after_m < 1.3 * right.distance_after_m + 1e-3).all()


def test_a_car_without_points_keeps_its_box_and_touches_no_other() -> None:
    points, _ = cars(False)
    alone = fit_shape(points, (TRUE_BOXES + ERRORS)[:1], "mmdet3d_lidar", PRIOR)
    far = TRUE_BOXES[:1] + torch.tensor([[50.0, 0, 0, 0, 0, 0, 0]])
    both = fit_shape(points, torch.cat([(TRUE_BOXES + ERRORS)[:1], far]), "mmdet3d_lidar", PRIOR)
    assert both.cars.status[1] is Status.too_few_points
    assert both.num_points.tolist() == [alone.num_points[0], 0]
    assert both.distance_after_m[1].isnan()
    T_far, hwl = boxes_to_poses(far, "mmdet3d_lidar", torch.eye(4).double())
    torch.testing.assert_close(both.cars.T_cam_obj[1:], T_far)
    torch.testing.assert_close(both.cars.boxes().dimensions_hwl[1:], hwl)
    torch.testing.assert_close(both.cars.T_cam_obj[0], alone.cars.T_cam_obj[0], atol=1e-8, rtol=0)
    assert len(fit_shape(points, far[:0], prior=PRIOR).cars) == 0
    with pytest.raises(InputError, match=r"points: expected shape \(P, 3\)"):
        fit_shape(points[:, :2], far, prior=PRIOR)


def scanned_dataset(root: Path) -> tuple[Path, Path]:
    """A data set of one frame with a scan of two cars and a file of their boxes, without images."""
    points, _ = cars(False)  # in the frame of a LiDAR
    T_cam_velo = torch.tensor([[0.0, -1, 0, 0.1], [0, 0, -1, -0.1], [1, 0, 0, 12.0], [0, 0, 0, 1]]).double()
    training, boxes = root / "training", root / "boxes"
    for folder in (training / "calib", root / "velodyne", boxes):
        folder.mkdir(parents=True)
    matrices = {"P2": "700 0 300 40 0 700 100 0 0 0 1 0", "P3": "700 0 300 -300 0 700 100 0 0 0 1 0"}
    matrices["R0_rect"] = "1 0 0 0 1 0 0 0 1"
    matrices["Tr_velo_to_cam"] = " ".join(str(x) for x in T_cam_velo[:3].flatten().tolist())
    (training / "calib" / "000003.txt").write_text("".join(f"{name}: {row}\n" for name, row in matrices.items()))
    scan = np.hstack([points.numpy(), np.zeros((len(points), 1))])
    (root / "velodyne" / "000003.bin").write_bytes(scan.astype("<f4").tobytes())
    T, hwl = boxes_to_poses(TRUE_BOXES + ERRORS, "mmdet3d_lidar", T_cam_velo)
    lines = ["Pedestrian 0 0 0 10 10 20 40 1.7 0.6 0.6 3 1.6 9 0"]
    for x, y, z, h, w, length, yaw in poses_to_boxes(T, hwl, "kitti").tolist():
        lines.append(f"Car 0 0 0 10 10 90 90 {h} {w} {length} {x} {y} {z} {yaw}")
    for name in ("000003", "000004"):
        (boxes / f"{name}.txt").write_text("".join(f"{line}\n" for line in lines))
    return root, boxes


def test_scans_of_a_data_set(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root, boxes = scanned_dataset(tmp_path)
    words = ["fit-shape", "--data", str(root), "--lidar", str(root / "velodyne"), "--boxes", str(boxes)]
    assert main([*words, "--out", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().out
    assert "000003  2 of 2 cars fitted" in said
    assert "no scan of 1 frames" in said
    before, after = (read_objects(folder / "000003.txt") for folder in (boxes, tmp_path / "out" / "data"))
    assert after[0].raw_line == before[0].raw_line
    # The same cars, in the frame of the labels: as far from the given boxes as the disturbance was.
    T_ref_velo = torch.tensor([[0.0, -1, 0, 0.1], [0, 0, -1, -0.1], [1, 0, 0, 12.0], [0, 0, 0, 1]]).double()
    true, _ = boxes_to_poses(TRUE_BOXES, "mmdet3d_lidar", T_ref_velo)
    for car, line in enumerate(after[1:]):
        assert line.location_ref[0] == pytest.approx(float(true[car, 0, 3]), abs=0.15)
        assert line.location_ref[2] == pytest.approx(float(true[car, 2, 3]), abs=0.15)
    assert {path.name for path in (tmp_path / "out" / "meshes").iterdir()} == {"000003_2.ply", "000003_3.ply"}
    with np.load(tmp_path / "out" / "shapes" / "000003.npz") as arrays:
        assert (arrays["distances_after_m"] < 0.5 * arrays["distances_before_m"]).all()
        assert arrays["input_lines"].tolist() == [2, 3]


def test_boxes_of_a_fitted_scan_are_those_of_its_result_lines(tmp_path: Path) -> None:
    root, boxes = scanned_dataset(tmp_path)
    dataset = open_dataset("kitti", root, boxes, frames=[3], lidar_dir=root / "velodyne")
    fit = fit_scan(dataset, "000003", tmp_path / "out", PCAShapePrior.load_bundled())
    lines = read_objects(tmp_path / "out" / "data" / "000003.txt")[1:]
    written = torch.tensor([line.location_ref for line in lines])
    assert torch.allclose(fit.cars.boxes().location_ref.float(), written, atol=0.006)
    assert fit.cars.t_cam_ref[0, 0] == pytest.approx(40 / 700)


def test_frames_need_their_scans(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root, boxes = scanned_dataset(tmp_path)
    words = ["fit-shape", "--data", str(root), "--lidar", str(boxes), "--boxes", str(boxes)]
    assert main([*words, "--out", str(tmp_path / "out")]) == 2
    assert "--lidar: expected a scan of frame 000003" in capsys.readouterr().err
    with pytest.raises(InputError, match="lidar_dir"):
        fit_scan(open_dataset("kitti", root, boxes), "000003", tmp_path, PCAShapePrior.load_bundled())
