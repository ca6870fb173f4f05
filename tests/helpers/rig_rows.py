"""This module has reduced observations of detections behind a rig with a known field, and the rig itself."""

from __future__ import annotations

import torch
from torch import Tensor

from directshape_torch.geometry.disparity_field import polynomial_basis
from directshape_torch.rig.estimate import RigEstimate

SIZE_WH = (1242, 375)
FOCAL_BASELINE = 721.0 * 0.54
# Some tenths of a pixel, as on KITTI: -0.3 in the middle, -1 at the edges.
FIELD = torch.tensor([-0.3, 0.1, 0.2, -0.3, 0.1, 0.2, -0.1, 0.1, 0.0, -0.4], dtype=torch.float64)


def estimate(
    rows: Tensor | None = None,
    size_wh: tuple[int, int] = SIZE_WH,
    focal_px: float = 721.0,
    sizes: Tensor | None = None,
) -> RigEstimate:
    """The estimate of a rig like KITTI's with these rows of detections and of sizes."""
    K = torch.tensor([[focal_px, 0, 620], [0, focal_px, 172], [0, 0, 1]], dtype=torch.float64)
    T_right_cam = torch.eye(4, dtype=torch.float64)
    T_right_cam[0, 3] = -0.54
    rig = RigEstimate(size_wh, K, K, T_right_cam)
    if rows is not None:
        rig.add_rows(rows)
    if sizes is not None:
        rig.add_sizes(sizes)
    return rig


def rows_of_cars(
    count: int,
    seed: int,
    bias: float = 0.0,
    noise: float = 0.03,
    field: Tensor = FIELD,
    u_range: tuple[float, float] = (60.0, 1180.0),
) -> Tensor:  # (N, 8)
    """Rows of cars 7 to 50 m ahead on a road, one in twelve with a wrong match."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(count, generator=generator, dtype=torch.float64)

    def normal() -> Tensor:
        return torch.randn(count, generator=generator, dtype=torch.float64)

    true = FOCAL_BASELINE / uniform(7, 50)
    u_v = torch.stack([uniform(*u_range), 172 + 1.9 * true + 6 * normal()], dim=1)
    offset_px = polynomial_basis(u_v, SIZE_WH) @ field
    measured = true + offset_px + 0.15 * normal()
    implied = true / (1 + bias + noise * normal())
    wrong = torch.rand(count, generator=generator) < 1 / 12
    offset = torch.where(wrong, measured - implied + 4.0, measured - implied)
    sigma, row_sigma = torch.full_like(true, 0.05), torch.full_like(true, 0.02)
    # The dimensions of this detector are 2 % too large, so its boxes look larger than their masks.
    size_error = bias - 0.02 + 0.06 * normal()
    size_error = torch.where(size_error.abs() < 0.2, size_error, 0.0)
    return torch.stack([*u_v.T, measured, offset, sigma, 0.2 + 0.05 * normal(), row_sigma, size_error], dim=1)
