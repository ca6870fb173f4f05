"""The visible points of two ellipsoid cars agree with the equation of the ellipsoids."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.ellipsoids import CENTRE_OBJ, HALF_AXES, ellipsoid_prior
from numpy.typing import NDArray

from directshape_torch.evaluation.shape_error import EstimatedCar
from directshape_torch.geometry.box3d import pose_from_kitti
from directshape_torch.shape.zero_level import sdf_to_mesh
from directshape_torch.visualize.drawing import View
from directshape_torch.visualize.painted_cars import FrameView

K = np.array([[150.0, 0.0, 77.0], [0.0, 150.0, 50.0], [0.0, 0.0, 1.0]])
PRIOR = ellipsoid_prior(spacing_m=0.1)
# The first car hides half of the second, and the border of the image cuts the third.
PLACES = (((0.0, 1.65, 8.0), 0.4), ((1.4, 1.65, 13.0), -0.9), ((-4.2, 1.65, 9.0), 0.1))
T_CAM_OBJ = [pose_from_kitti(torch.tensor(place).double(), torch.tensor(yaw).double()) for place, yaw in PLACES]


def view(image: NDArray[np.uint8] | None = None) -> FrameView:
    cars = [EstimatedCar(PRIOR, torch.zeros(3).double(), T) for T in T_CAM_OBJ]
    left = View(np.zeros((120, 160, 3), np.uint8) if image is None else image, np.column_stack([K, np.zeros(3)]))
    return FrameView(left, cars, [None] * len(cars))


def surface(car: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Vertices and outward normals of a car in camera coordinates; the normals are those of the ellipsoid."""
    mesh = sdf_to_mesh(PRIOR.values(torch.zeros(1, 3).double())[0], PRIOR.origin, PRIOR.spacing_m)
    normals = (mesh.vertices - CENTRE_OBJ) / np.array(HALF_AXES) ** 2
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    T = T_CAM_OBJ[car].numpy()
    return np.asarray(mesh.vertices @ T[:3, :3].T + T[:3, 3]), np.asarray(normals @ T[:3, :3].T)


def hidden_behind(points_cam: NDArray[np.float64], car: int) -> NDArray[np.bool_]:
    """Whether the ray to each point meets the ellipsoid of a car before the point, by a quadratic equation."""
    T = T_CAM_OBJ[car].numpy()
    start = (-T[:3, 3] @ T[:3, :3] - CENTRE_OBJ) / HALF_AXES
    way = points_cam @ T[:3, :3] / HALF_AXES
    a, b, c = (way**2).sum(1), (way * start).sum(1), start @ start - 1
    first = (-b - np.sqrt(np.maximum(b**2 - a * c, 0))) / a
    return np.asarray((b**2 > a * c) & (first > 0) & (first < 1 - 0.05 / points_cam[:, 2]))


@pytest.mark.parametrize("car", [0, 1, 2])
def test_seen_is_what_no_ellipsoid_hides(car: int) -> None:
    points, normals = surface(car)
    cosine = -(points * normals).sum(1) / np.linalg.norm(points, axis=1)
    uv = points @ K.T
    uv = uv[:, :2] / uv[:, 2:]
    in_image = (uv >= 0).all(1) & (uv <= [159, 119]).all(1)
    hidden = np.any([hidden_behind(points, other) for other in range(3) if other != car], axis=0)
    wanted = (cosine > 0.2) & in_image & ~hidden
    got = view().is_seen(car, points, normals)
    # The field is known at nodes of 0.1 m, so the outline of the car in front is a little off.
    assert (got != wanted).mean() < 0.005
    assert 0.05 < wanted.mean() < 0.5
    if car:
        assert (hidden if car == 1 else ~in_image)[cosine > 0.2].mean() > 0.2


def test_a_mask_takes_away_what_it_does_not_cover() -> None:
    points, normals = surface(0)
    everything = view()
    mask = np.zeros((120, 160), dtype=bool)
    mask[:, 77:] = True
    masked = replace(everything, masks=[mask, None, None])
    whole, part = (one.is_seen(0, points, normals) for one in (everything, masked))
    u = np.rint(points[:, 0] / points[:, 2] * 150 + 77)
    np.testing.assert_array_equal(part, whole & (u >= 77))
    assert 0.3 < part.sum() / whole.sum() < 0.7


def test_colours_are_those_between_pixels() -> None:
    """An image that is linear in u and v gives back the pixel itself."""
    v, u = np.mgrid[:120, :160]
    image = np.stack([u, v, np.full_like(u, 7)], axis=-1).astype(np.uint8)
    uv = np.array([[10.4, 20.6], [0.0, 0.0], [159.0, 119.0], [158.6, 118.4], [200.0, -9.0]])
    points = np.concatenate([(uv - K[:2, 2]) / 150, np.ones((5, 1))], axis=1) * 12.0
    wanted = [[10, 21, 7], [0, 0, 7], [159, 119, 7], [159, 118, 7], [159, 0, 7]]
    np.testing.assert_array_equal(view(image).colours(points), wanted)
