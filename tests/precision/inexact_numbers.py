"""This module has numbers that lose digits in every product with fewer digits than float32 has."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from directshape_torch.geometry import se3


@dataclass(frozen=True)
class Numbers:
    """A `Numbers` has tensors of one dtype in which no product is exact in fewer digits than float32 has."""

    uv: Tensor  # (20, 2) pixels
    depth: Tensor  # (20,) metres
    points: Tensor  # (20, 3) metres, in the camera frame
    near: Tensor  # (20, 3) metres, in the object frame
    twist: Tensor  # (2, 6)
    T: Tensor  # (2, 4, 4)
    T_cam_lidar: Tensor  # (4, 4), turned by right angles
    K: Tensor  # (3, 3)
    T_right_cam: Tensor  # (4, 4)
    P_left: Tensor  # (1, 3, 4)
    P_right: Tensor  # (1, 3, 4)
    boxes: Tensor  # (2, 7)
    boxes_beside: Tensor  # (2, 7), partly in the same place
    hwl: Tensor  # (2, 3)
    code: Tensor  # (2, 3)
    images: Tensor  # (1, 3, 120, 160)

    def to(self, dtype: torch.dtype) -> Numbers:
        return Numbers(**{name: value.to(dtype) for name, value in vars(self).items()})


@cache
def numbers() -> Numbers:
    """Numbers of float32."""
    chance = torch.Generator().manual_seed(0)

    def between(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(shape, generator=chance)

    K = torch.tensor([[721.5377, 0.0, 609.5593], [0.0, 721.5377, 172.854], [0.0, 0.0, 1.0]])
    T_right_cam, T_cam_lidar = torch.eye(4), torch.zeros(4, 4)
    T_right_cam[:3, 3] = torch.tensor([-0.5327, 0.0027, 0.0031])
    T_cam_lidar[0, 1] = T_cam_lidar[1, 2] = -1
    T_cam_lidar[2, 0] = T_cam_lidar[3, 3] = 1
    T_cam_lidar[:3, 3] = torch.tensor([0.0613, -0.0871, -0.2713])
    points = torch.stack([between(-9, 9, 20), between(-1, 2, 20), between(7, 40, 20)], dim=1)
    twist = between(-1, 1, 2, 6)
    boxes = torch.stack([points[0], points[1]])
    sizes = torch.tensor([[1.523, 1.617, 4.013, 0.317], [1.481, 1.703, 4.391, -1.217]])
    boxes = torch.cat([boxes, sizes], dim=1)
    P_left, P_right = (
        torch.cat([K, torch.tensor(x)], dim=1)[None]
        for x in ([[44.857], [0.216], [0.003]], [[-339.524], [2.199], [0.003]])
    )
    return Numbers(
        uv=between(3, 157, 20, 2),
        depth=between(7, 40, 20),
        points=points,
        near=between(-1.2, 1.2, 20, 3),
        twist=twist,
        T=se3.exp(twist.double()).float(),
        T_cam_lidar=T_cam_lidar,
        K=K,
        T_right_cam=T_right_cam,
        P_left=P_left,
        P_right=P_right,
        boxes=boxes,
        boxes_beside=boxes + 0.31,
        hwl=sizes[:, :3],
        code=between(-2, 2, 2, 3),
        images=between(0, 1, 1, 3, 120, 160),
    )
