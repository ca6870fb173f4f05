"""Points of estimated cars, and of the truth: where they lie and which of them are seen."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.ellipsoids import CENTRE_OBJ, HALF_AXES, ellipsoid_prior
from helpers.synthetic_scene import stereo_camera

from directshape_torch.errors import DataFormatError
from directshape_torch.evaluation.shape_truth import (
    EstimatedCar,
    SceneDepth,
    SurfaceTruth,
    read_surface_points,
    segment_truth,
)
from directshape_torch.geometry.box3d import pose_from_kitti

T_CAM_OBJ = pose_from_kitti(torch.tensor([[0.5, 1.65, 10.0]], dtype=torch.float64), torch.tensor([0.6]))[0]


@pytest.fixture(scope="module")
def car() -> EstimatedCar:
    return EstimatedCar(ellipsoid_prior(), torch.zeros(3, dtype=torch.float64), T_CAM_OBJ)


def level(points_cam: np.ndarray) -> np.ndarray:
    """0 on the ellipsoid, in units of its half axes."""
    T = T_CAM_OBJ.double().numpy()
    points_obj = (points_cam - T[:3, 3]) @ T[:3, :3]
    return np.linalg.norm((points_obj - CENTRE_OBJ) / np.array(HALF_AXES), axis=1) - 1


def normals_cam(points_cam: np.ndarray) -> np.ndarray:
    T = T_CAM_OBJ.double().numpy()
    points_obj = (points_cam - T[:3, 3]) @ T[:3, :3]
    normals = (points_obj - CENTRE_OBJ) / np.array(HALF_AXES) ** 2
    return (normals / np.linalg.norm(normals, axis=1, keepdims=True)) @ T[:3, :3].T


def test_sampled_points_lie_on_the_surface_uniformly_by_area(car: EstimatedCar) -> None:
    points = car.sampled_points(4000, seed=0)
    assert points.shape == (4000, 3)
    # A grid of 0.2 m knows the half axes to a few centimetres.
    assert np.abs(level(points)).max() < 0.08
    assert np.array_equal(points, car.sampled_points(4000, seed=0))
    assert not np.array_equal(points, car.sampled_points(4000, seed=1))
    # The ellipsoid is symmetric, so each half of it has half the area: 4000 throws differ by 2 % at 2.5 sigma.
    centre = T_CAM_OBJ.double().numpy() @ np.array([*CENTRE_OBJ, 1.0])
    axes = T_CAM_OBJ.double().numpy()[:3, :3]
    assert (((points - centre[:3]) @ axes) > 0).mean(axis=0) == pytest.approx([0.5] * 3, abs=0.025)


def test_points_at_pixels_are_the_first_hits_of_their_rays(car: EstimatedCar) -> None:
    K = torch.tensor([[700.0, 0, 600], [0, 700, 180], [0, 0, 1]], dtype=torch.float64)
    u, v = np.meshgrid(np.arange(400.0, 900, 7), np.arange(100.0, 300, 7))
    uv = np.stack([u.ravel(), v.ravel()], axis=-1)
    points = car.points_at_pixels(uv, K)
    found = np.rint((points / points[:, 2:]) @ K.numpy().T)[:, :2]
    rows = [np.flatnonzero((uv == pixel).all(axis=1))[0] for pixel in found]
    least, first = first_hit(uv, K.numpy())
    hit = np.zeros(len(uv), dtype=bool)
    hit[rows] = True
    # The grid of 0.2 m knows the outline to some percent of the half axes.
    assert hit[least < 0.85].all()
    assert not hit[least > 1.1].any()
    clear = least[rows] < 0.85
    assert clear.sum() > 100
    assert np.abs(points[:, 2] - first[rows])[clear].max() < 0.12


def first_hit(uv: np.ndarray, K: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of each ray its least level of the ellipsoid (below 1 inside), and the depth where it enters (NaN: it misses)."""
    T = T_CAM_OBJ.double().numpy()
    rays = np.concatenate([uv, np.ones((len(uv), 1))], axis=1) @ np.linalg.inv(K).T
    origin = (-T[:3, 3] @ T[:3, :3] - CENTRE_OBJ) / np.array(HALF_AXES)
    direction = (rays @ T[:3, :3]) / np.array(HALF_AXES)
    a, b, c = (direction**2).sum(1), direction @ origin, origin @ origin - 1
    least = np.sqrt(np.maximum(c + 1 - b**2 / a, 0))
    with np.errstate(invalid="ignore"):
        return least, (-b - np.sqrt(b**2 - a * c)) / a


def street_scene() -> SceneDepth:
    """An image of KITTI's size without any car."""
    K = np.array([[700.0, 0, 600], [0, 700, 180], [0, 0, 1]])
    return SceneDepth(np.full((375, 1242), 50.0), np.zeros((375, 1242), dtype=np.int64), K)


def test_the_side_that_is_turned_away_is_not_seen(car: EstimatedCar) -> None:
    points = car.sampled_points(2000, seed=0)
    slope = (normals_cam(points) * points).sum(axis=1) / np.linalg.norm(points, axis=1)
    clear = np.abs(slope) > 0.25
    seen = street_scene().with_estimate(car, points, 1001).shows(points, 1001)
    assert np.array_equal(seen[clear], (slope < 0)[clear])


def test_an_estimate_is_hidden_by_nearer_cars_only(car: EstimatedCar) -> None:
    """Left of column 640 stands a car at 5 m, right of it one at 20 m: the estimate is at 10 m."""
    scene = street_scene()
    scene.instance[:, :640], scene.depth_m[:, :640] = 1002, 5.0
    scene.instance[:, 640:], scene.depth_m[:, 640:] = 1003, 20.0
    points = car.sampled_points(2000, seed=0)
    alone = street_scene().with_estimate(car, points, 1001).shows(points, 1001)
    seen = scene.with_estimate(car, points, 1001).shows(points, 1001)
    column = 700 * points[:, 0] / points[:, 2] + 600
    assert not seen[column < 639].any()
    assert np.array_equal(seen[column > 641], alone[column > 641])
    assert seen.any()


def test_the_true_car_does_not_stand_before_its_own_estimate(car: EstimatedCar) -> None:
    """The true car fills the image at 2 m; in the image of the estimate it is gone."""
    scene = street_scene()
    scene.instance[:], scene.depth_m[:] = 1001, 2.0
    points = car.sampled_points(500, seed=0)
    view = scene.with_estimate(car, points, 1001)
    assert 0 < (view.instance == 1001).sum() < 0.2 * view.instance.size
    assert view.depth_m[view.instance == 1001].min() > 7.0


def test_points_of_a_segment_are_those_of_the_disparity() -> None:
    """f 150, b 0.53, right camera 0.004 behind: z = (f 0.53 + ...)/d; checked by projecting into the right image."""
    camera = stereo_camera(20, 12, 150.0)
    disparity = np.zeros((12, 20))
    disparity[3, 5], disparity[4, 6], disparity[9, 9] = 8.0, 10.0, 7.0
    inside = np.zeros((12, 20), dtype=bool)
    inside[:6] = True
    truth = segment_truth("mask", disparity, inside, camera)
    assert truth.uv_left.tolist() == [[5, 3], [6, 4]]
    K, right = camera.K_right[0].numpy(), truth.points_cam + camera.T_right_cam[0, :3, 3].numpy()
    u_right = (right @ K.T)[:, 0] / right[:, 2]
    assert truth.uv_left[:, 0] - u_right == pytest.approx([8.0, 10.0])
    assert truth.points_cam[:, 2] == pytest.approx([150 * 0.53 / 8, 150 * 0.53 / 10], rel=0.01)


def scene() -> SceneDepth:
    """8 x 6 pixels, f = 10: car 1001 in columns 2 and 3 at 5 m, car 1002 in columns 4 and 5 at 3 m, else ground."""
    depth, instance = np.full((6, 8), 20.0), np.zeros((6, 8), dtype=np.int64)
    depth[:, 2:4], instance[:, 2:4] = 5.0, 1001
    depth[:, 4:6], instance[:, 4:6] = 3.0, 1002
    return SceneDepth(depth, instance, np.diag([10.0, 10.0, 1.0]))


def at(u: float, z: float) -> list[float]:
    return [u * z / 10, 2 * z / 10, z]


def test_what_a_depth_map_shows() -> None:
    """Seen: on the surface; not: behind it, in front of another car's pixel, beside the car, outside, behind."""
    points = np.array([at(2, 5.0), at(2, 5.5), at(4, 5.0), at(1, 5.0), at(40, 5.0), [0.0, 0.0, -1.0]])
    assert scene().shows(points, 1001).tolist() == [True, False, False, False, False, False]


def test_a_slanted_surface_may_be_as_deep_as_its_neighbour_pixels() -> None:
    slanted = scene()
    slanted.depth_m[:, 3] = 6.0
    points = np.array([at(2, 5.9), at(2, 6.2)])
    assert slanted.shows(points, 1001).tolist() == [True, False]


def test_a_perfect_estimate_is_as_good_as_its_sampling_limit(car: EstimatedCar) -> None:
    """Truth: other points of the same surface, in an image that shows it alone."""
    points = car.sampled_points(4000, seed=7)
    scene = street_scene().with_estimate(car, points, 1001)
    truth = SurfaceTruth("x", points, scene.shows(points, 1001), scene, 1001)
    errors, limits = truth.errors(car), truth.sampling_limit(car)
    assert set(errors) == set(limits) == {"whole", "visible"}
    assert errors["visible"].num_true == limits["visible"].num_true == int(truth.visible.sum())
    assert limits["whole"].num_true == 4000
    for name, error in errors.items():
        assert error.completeness == pytest.approx(limits[name].completeness, abs=0.04)
        assert error.accuracy == pytest.approx(limits[name].accuracy, abs=0.04)
        assert error.completeness[3] > 0.999
        assert error.rmse_m[3] == pytest.approx(limits[name].rmse_m[3], abs=0.003)


def test_broken_files(tmp_path: Path) -> None:
    with pytest.raises(DataFormatError, match="cannot be read"):
        read_surface_points(tmp_path / "none.npz")
    (tmp_path / "text.npz").write_text("no archive")
    np.savez(tmp_path / "other.npz", vertices=np.zeros((4, 3)))
    np.savez(tmp_path / "flat.npz", points=np.zeros((4, 2)))
    np.savez(tmp_path / "nan.npz", points=np.full((4, 3), np.nan))
    for name, text in (
        ("text", "no readable npz file"),
        ("other", "'points'"),
        ("flat", r"shape \(N, 3\)"),
        ("nan", "not finite"),
    ):
        with pytest.raises(DataFormatError, match=text):
            read_surface_points(tmp_path / f"{name}.npz")
