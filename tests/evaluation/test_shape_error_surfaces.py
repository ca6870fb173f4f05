"""Points of estimated cars, and of the truth: where they lie."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.ellipsoids import CENTRE_OBJ, HALF_AXES, ellipsoid_prior
from helpers.synthetic_scene import stereo_camera

from directshape_torch.errors import DataFormatError
from directshape_torch.evaluation.shape_truth import EstimatedCar, read_depth, segment_truth
from directshape_torch.files.atomic_files import write_png
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


def test_points_at_pixels_are_the_first_hits_of_their_rays(car: EstimatedCar) -> None:
    K = torch.tensor([[700.0, 0, 600], [0, 700, 180], [0, 0, 1]], dtype=torch.float64)
    u, v = np.meshgrid(np.arange(400.0, 900, 7), np.arange(100.0, 300, 7))
    uv = np.stack([u.ravel(), v.ravel()], axis=-1)
    points = car.points_at_pixels(uv, K)
    hit = np.isfinite(points).all(axis=1)
    seen = points[hit] @ K.numpy().T
    np.testing.assert_allclose(seen[:, :2] / seen[:, 2:], uv[hit], atol=1e-3)
    least, first = first_hit(uv, K.numpy())
    # The grid of 0.2 m knows the outline to some percent of the half axes.
    assert hit[least < 0.85].all()
    assert not hit[least > 1.1].any()
    clear = least < 0.85
    assert clear.sum() > 100
    assert np.abs(points[:, 2] - first)[clear].max() < 0.12


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


def test_points_of_a_segment_are_those_of_its_known_depths() -> None:
    camera = stereo_camera(20, 12, 150.0)
    depth = np.full((12, 20), np.nan)
    depth[3, 5], depth[4, 6], depth[9, 9] = 8.0, 10.0, 7.0
    inside = np.zeros((12, 20), dtype=bool)
    inside[:6] = True
    truth = segment_truth("mask", depth, inside, camera)
    assert truth.uv_left.tolist() == [[5, 3], [6, 4]]
    assert truth.points_cam[:, 2].tolist() == [8.0, 10.0]
    again = truth.points_cam @ camera.K_left[0].numpy().T
    np.testing.assert_allclose(again[:, :2] / again[:, 2:], truth.uv_left)


def test_maps_of_depth(tmp_path: Path) -> None:
    write_png(tmp_path / "a.png", np.array([[0, 128, 2560]], dtype=np.uint16))
    np.testing.assert_array_equal(read_depth(tmp_path / "a.png"), [[np.nan, 0.5, 10.0]])
    write_png(tmp_path / "b.png", np.zeros((2, 2), dtype=np.uint8))
    with pytest.raises(DataFormatError, match="expected 16 bits"):
        read_depth(tmp_path / "b.png")
