"""Projection and back-projection."""

from __future__ import annotations

import pytest
import torch

from directshape_torch.geometry.camera import rays_from_pixels
from directshape_torch.geometry.projection import project

K = torch.tensor([[700.0, 0.4, 600.0], [0.0, 690.0, 180.0], [0.0, 0.0, 1.0]], dtype=torch.float64)


@pytest.mark.parametrize("shape", [(), (0,), (1,), (4,), (2, 3)])
def test_project_undoes_back_projection(shape: tuple[int, ...]) -> None:
    uv = 1000 * torch.rand(*shape, 2, dtype=torch.float64)
    depth = 1 + 50 * torch.rand(*shape, 1, dtype=torch.float64)
    torch.testing.assert_close(project(depth * rays_from_pixels(uv, K), K), uv)


def test_rays_are_k_inverse_with_unit_depth() -> None:
    uv = torch.tensor([[0.0, 0.0], [321.5, 77.0]], dtype=torch.float64)
    homogeneous = torch.cat([uv, torch.ones(2, 1, dtype=torch.float64)], dim=1)
    torch.testing.assert_close(rays_from_pixels(uv, K), homogeneous @ torch.linalg.inv(K).T)
    assert (rays_from_pixels(uv, K)[:, 2] == 1).all()


def test_numbers_by_hand() -> None:
    # u = 700 * 2 / 10 + 0.4 * (-1) / 10 + 600 = 739.96; v = 690 * (-1) / 10 + 180 = 111.
    point = torch.tensor([2.0, -1.0, 10.0], dtype=torch.float64)
    torch.testing.assert_close(project(point, K), torch.tensor([739.96, 111.0], dtype=torch.float64))


def test_a_batch_of_cameras() -> None:
    cameras = torch.stack([K, 0.5 * K])
    cameras[1, 2, 2] = 1
    point = torch.tensor([2.0, -1.0, 10.0], dtype=torch.float64)
    both = project(point.expand(2, 3), cameras)
    torch.testing.assert_close(both[1], 0.5 * both[0])
