"""Photometric residuals of one surface at many disparities: what a search along the viewing rays would see.

In the inverse depth the warp is a sum, `h = K_right (R ray + t / depth)`, homogeneous, and an offset of the disparity
adds to `1 / depth`: all offsets share the products. No derivative is needed, so the lookup is PyTorch's own.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class DisparityResiduals(NamedTuple):
    """Residuals of P pixels and their N neighbourhood pixels at n offsets of disparity."""

    residual: Tensor  # (n, P, N) right minus left, grey levels
    inside: Tensor  # (n, P) bool: in front of the camera, and every neighbourhood pixel lands in the right image
    uv_right: Tensor  # (n, P, 2) where the pixel itself lands


def disparity_residuals(
    image_right: Tensor,  # (F, H, W) grey levels, at some pyramid level
    sizes: Tensor,  # (F, 2) height, width at that level
    level_scale: float,  # pixels of the level per full-resolution pixel
    frame_index: Tensor,  # (P,)
    intensity_left: Tensor,  # (P, N) grey levels, already brought to the right image's brightness
    rays_left: Tensor,  # (P, N, 3) K^-1 [u, v, 1] of the neighbourhood pixels
    depth: Tensor,  # (P,)
    K_right: Tensor,  # (P, 3, 3)
    T_right_cam: Tensor,  # (P, 4, 4)
    bias_px: Tensor | None,  # (P,)
    vertical_px: Tensor | None,  # (P,)
    centre: int,  # which neighbourhood pixel is the pixel itself
    offsets_px: Tensor,  # (n,) of the disparity, full-resolution pixels
) -> DisparityResiduals:
    """`photometric_residual` with the depth of every pixel moved to `depth / (1 + offset depth / (f b))`.

    A depth that an offset moves to infinity or beyond is not inside.
    """
    to_level = _pinhole_to_level(level_scale, depth, bias_px, vertical_px) @ K_right
    along_ray = (rays_left @ (to_level @ T_right_cam[:, :3, :3]).mT)[..., None]
    along_baseline = (to_level @ T_right_cam[:, :3, 3:])[:, None]
    focal_baseline = -K_right[:, 0, 0] * T_right_cam[:, 0, 3]
    # The offsets are the last axis: they are what every operation runs over without a jump in memory.
    inverse_depth = (1 / depth)[:, None] + offsets_px / focal_baseline[:, None]
    x, y, z = (torch.addcmul(along_ray[:, :, i], along_baseline[:, :, i], inverse_depth[:, None]) for i in range(3))
    in_front = (z > 0) & (inverse_depth > 0)[:, None]
    z = torch.where(in_front, z, 1.0)
    u, v = x / z, y / z
    last_v, last_u = (sizes - 1)[frame_index].to(depth.dtype)[..., None, None].unbind(1)
    inside = (in_front & (u >= 0) & (u <= last_u) & (v >= 0) & (v <= last_v)).all(dim=1)
    residual = _lookup(image_right, frame_index, u, v) - intensity_left[..., None]
    uv_right = (torch.stack([u[:, centre], v[:, centre]], dim=-1) + 0.5) / level_scale - 0.5
    return DisparityResiduals(residual.permute(2, 0, 1), inside.mT, uv_right.transpose(0, 1))


def _pinhole_to_level(scale: float, like: Tensor, bias_px: Tensor | None, vertical_px: Tensor | None) -> Tensor:
    """Matrices (P, 3, 3) from homogeneous pinhole pixels to the pixels of the rig at the pyramid level."""
    matrix = torch.eye(3, dtype=like.dtype, device=like.device).repeat(len(like), 1, 1)
    for axis, shift in enumerate((None if bias_px is None else -bias_px, vertical_px)):
        matrix[:, axis, axis] = scale
        matrix[:, axis, 2] = 0.5 * scale - 0.5 if shift is None else (shift + 0.5) * scale - 0.5
    return matrix


def _lookup(images: Tensor, frame_index: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Bilinear values (P, N, n); the frames stand on top of one another, so that one call serves the cars of all."""
    num_frames, height, width = images.shape
    row = v if num_frames == 1 else v + (frame_index * height)[:, None, None]
    per_u, per_v = 2 / width, 2 / (num_frames * height)
    grid = torch.stack([u * per_u + (0.5 * per_u - 1), row * per_v + (0.5 * per_v - 1)], dim=-1)
    values = torch.nn.functional.grid_sample(
        images.reshape(1, 1, num_frames * height, width),
        grid.flatten(1, 2)[None],
        mode="bilinear",
        padding_mode="border",
        align_corners=False,
    )
    return values.view(u.shape)
