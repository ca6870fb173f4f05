"""Photometric rows in blocks of 64 before images with hidden parts, and their residuals one pixel at a time."""

from __future__ import annotations

import torch
from torch import Tensor

from directshape_torch.image.interpolate import bilinear_with_gradient
from directshape_torch.residuals.photometric_patch import patch_residual
from directshape_torch.tracking.photometric import PhotometricRows, PhotometricSettings, RightView
from directshape_torch.tracking.rays import ObjectBlockRays
from helpers.block_fields import objects_ahead, random, random_rays

OWNER = torch.tensor([0, 0, 2, 1])
FRAME = torch.tensor([1, 1, 0, 1])  # of the blocks
SIZES = torch.tensor([[40, 60], [30, 48]])  # height, width; the second image is padded
NUM_NEIGHBOURS, CENTRE = 8, 4
LEVEL_SCALE = 0.5
SETTINGS = {
    "plain": PhotometricSettings(9.0, 30.0, False, 0.1, "plain", 2.0),
    "truncated": PhotometricSettings(9.0, 30.0, True, 0.1, "plain", 2.0),
    "normalised": PhotometricSettings(9.0, 30.0, False, 0.1, "normalised", 2.0),
    "lost within the corner": PhotometricSettings(40.0, 12.0, False, 0.1, "plain", 2.0),
}


# (F, H, W) grey levels, smooth over a few pixels.
IMAGES = torch.nn.functional.interpolate(
    128 + random(2, 1, 14, 20, seed=21, scale=60.0), size=(40, 60), mode="bicubic", align_corners=True
)[:, 0]


def right_view() -> RightView:
    """Objects 0 and 1 are hidden in some pixels of a crop of their frame; object 2 is never."""
    height, width = IMAGES.shape[1:]
    last = SIZES[FRAME] - 1
    frame = torch.stack([FRAME * height * width, torch.full_like(FRAME, width), last[:, 1], last[:, 0]], dim=1)
    crops = torch.tensor([[30, 10, 60, 50, 5 - 10 * 40 - 30, 40], [20, 5, 70, 45, 2000 - 5 * 55 - 20, 55], [0] * 6])
    bits = torch.tensor([[1, 0], [4, 2], [0, 0]])
    generator = torch.Generator().manual_seed(22)
    covering = torch.randint(0, 8, (5000, 2), generator=generator)
    full_per_level = torch.tensor([1 / LEVEL_SCALE, 0.5 / LEVEL_SCALE - 0.5], dtype=torch.float64)
    return RightView(
        IMAGES.reshape(-1), frame, full_per_level.expand(len(OWNER), 2), crops[OWNER], bits[OWNER], covering
    )


def rows_of() -> PhotometricRows:
    """Pixels whose neighbours land about the middle of the right image, some outside, one behind the camera."""
    count = len(OWNER)
    rays = random_rays(OWNER, spread=0.08)
    generator = torch.Generator().manual_seed(23)
    offset = torch.randint(-2, 3, (2, NUM_NEIGHBOURS, 1, 1), generator=generator).double()
    centre = torch.tensor([26.0, 18.0], dtype=torch.float64).view(2, 1, 1, 1)
    u, v = (
        90.0 * rays.ray_cam[:2, None] + centre + offset + random(2, NUM_NEIGHBOURS, count, 64, seed=24, scale=0.3)
    ).unbind(0)
    z = 1 + random(NUM_NEIGHBOURS, count, 64, seed=25, scale=1e-3)
    z[2, 0, 5] = -1.0
    neighbour = (torch.rand(NUM_NEIGHBOURS, count, 64, generator=generator) > 0.2).double()
    neighbour[:, 1, 7] = 0.0
    weight = torch.rand(count, 64, generator=generator, dtype=torch.float64)
    weight[1, 40:] = 0.0  # empty places
    return PhotometricRows(
        rays=rays,
        along_ray=torch.stack([u, v, z]),
        along_baseline=random(3, count, 64, seed=26) * torch.tensor([20.0, 2.0, 0.01]).double().view(3, 1, 1),
        intensity_left=128 + random(NUM_NEIGHBOURS, count, 64, seed=27, scale=20.0),
        pixel_weight=weight,
        neighbour_weight=neighbour,
        right=right_view(),
    )


def warped(rows: PhotometricRows, depth: Tensor, m: int) -> tuple[Tensor, Tensor]:
    """Pixels (64, N, 2) of the level where the neighbours of a block land, and the homogeneous coordinate."""
    h = rows.along_ray[:, :, m] * depth[m] + rows.along_baseline[:, None, m]
    z = torch.where(h[2] > 1e-6, h[2], torch.ones_like(h[2]))
    return torch.stack([h[0] / z, h[1] / z], dim=-1).transpose(0, 1), h[2].mT


def is_hidden(right: RightView, m: int, uv_level: Tensor) -> bool:
    """Whether a bit of an instance in front of the object is set at the nearest full-resolution pixel."""
    u, v = (round(float((x + 0.5) / LEVEL_SCALE - 0.5)) for x in uv_level)
    u0, v0, u1, v1, first, width = right.crop[m].tolist()
    if not (u0 <= u < u1 and v0 <= v < v1):
        return False
    return bool((right.covering[first + v * width + u] & right.in_front[m]).any())


def residuals_one_by_one(rows: PhotometricRows, settings: PhotometricSettings, depth: Tensor) -> tuple[Tensor, Tensor]:
    """(M, 64, N) and which pixels can be compared, by the lookup of whole images."""
    values, comparable = [], torch.zeros(len(OWNER), 64, dtype=torch.bool)
    for m, f in enumerate(FRAME.tolist()):
        uv, z = warped(rows, depth, m)
        value, _, inside = bilinear_with_gradient(IMAGES, torch.full((64, 1), f), uv, SIZES)
        left, weight = rows.intensity_left[:, m].mT, rows.neighbour_weight[:, m].mT
        floor = settings.contrast_floor_grey_levels
        values.append(patch_residual(value - left, left, weight, settings.patch, floor))
        hidden = torch.tensor([is_hidden(rows.right, m, uv[i, CENTRE].detach()) for i in range(64)])
        comparable[m] = (inside & (z > 1e-6)).all(dim=1) & ~hidden
    return torch.stack(values), comparable


def residuals_one_by_one_values(rows: PhotometricRows, settings: PhotometricSettings, depth: Tensor) -> Tensor:
    """Without what is decided by values."""
    values = []
    for m, f in enumerate(FRAME.tolist()):
        uv, _ = warped(rows, depth, m)
        value = bilinear_with_gradient(IMAGES, torch.full((64, 1), f), uv, SIZES)[0]
        left, weight = rows.intensity_left[:, m].mT, rows.neighbour_weight[:, m].mT
        floor = settings.contrast_floor_grey_levels
        values.append(patch_residual(value - left, left, weight, settings.patch, floor))
    return torch.stack(values)


def in_objects(rows: PhotometricRows) -> ObjectBlockRays:
    return rows.rays.in_objects(of_blocks(rows))


def of_blocks(rows: PhotometricRows) -> Tensor:
    return rows.rays.of_blocks(objects_ahead(3))


def spread(vectors: Tensor) -> Tensor:
    """(B, 3) as (3, M, 64)."""
    return vectors[OWNER].mT[..., None].expand(3, -1, 64).contiguous()


def facing(rays: ObjectBlockRays) -> Tensor:
    """Normals (B, 3) of planes that the rays of each object meet from outside, of lengths other than 1."""
    away = torch.stack([-rays.direction_obj[:, b == OWNER].mean(dim=(1, 2)) for b in range(3)])
    return (away + random(3, 3, seed=31, scale=0.15)) * torch.tensor([[0.7], [1.0], [1.4]]).double()
