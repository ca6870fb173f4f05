"""Photometric residuals of one surface at many disparities: what a search along the viewing rays would see.

In the inverse depth the warp is a line, `h = K_right (R ray + t / depth)`, homogeneous, and an offset of the disparity
adds to `1 / depth`: all offsets share the line. No derivative is needed, so the lookup is PyTorch's own. The pixels are
the last axis of everything here: they are many, and every operation runs over them without a jump in memory.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.geometry.short_axes import all_along

# Depths in the right camera are at least this; what is not in front is not inside, wherever it would land.
_LEAST_DEPTH_M = 1e-6


class DisparityResiduals(NamedTuple):
    """Residuals of P pixels and their N neighbourhood pixels at n offsets of disparity."""

    residual: Tensor  # (n, P, N) right minus left, grey levels
    inside: Tensor  # (n, P) bool: in front of the camera, and every neighbourhood pixel lands in the right image
    uv_right: Tensor  # (n, P, 2) where the pixel itself lands


class WarpLines(NamedTuple):
    """Where P pixels and their N neighbours land in the right image, as functions of the inverse depth."""

    along_ray: Tensor  # (3, N, P) homogeneous pixels of the pyramid level at infinite depth
    along_baseline: Tensor  # (3, 1, P) what a unit of inverse depth adds
    per_offset: Tensor  # (P,) inverse depth of a pixel of disparity

    def select(self, chosen: Tensor) -> WarpLines:
        """Those of some of the pixels, rows (R,)."""
        return WarpLines(*(x[..., chosen] for x in self))


def warp_lines(
    level_scale: float,  # pixels of the level per full-resolution pixel
    rays_left: Tensor,  # (P, N, 3) K^-1 [u, v, 1] of the neighbourhood pixels
    K_right: Tensor,  # (P, 3, 3)
    T_right_cam: Tensor,  # (P, 4, 4)
    bias_px: Tensor | None,  # (P,)
    vertical_px: Tensor | None,  # (P,)
) -> WarpLines:
    """The warp of `photometric_residual` as a line in the inverse depth of each pixel."""
    pinhole = K_right @ T_right_cam[:, :3]
    shift_u = 0.5 if bias_px is None else 0.5 - bias_px
    shift_v = 0.5 if vertical_px is None else 0.5 + vertical_px
    last = pinhole[:, 2]
    u, v = (
        level_scale * pinhole[:, axis] + torch.as_tensor(shift * level_scale - 0.5).to(last).view(-1, 1) * last
        for axis, shift in enumerate((shift_u, shift_v))
    )
    line = torch.stack([u, v, last]).transpose(1, 2).contiguous()  # (3, 4, P)
    rays = rays_left.permute(2, 1, 0).contiguous()
    along_ray = (line[:, :3, None] * rays).sum(dim=1)
    per_offset = -1 / (K_right[:, 0, 0] * T_right_cam[:, 0, 3])
    return WarpLines(along_ray, line[:, 3:], per_offset)


def residuals_on_lines(
    lines: WarpLines,
    depth: Tensor,  # (P,)
    image_right: Tensor,  # (F, H, W) grey levels, at some pyramid level
    sizes: Tensor,  # (F, 2) height, width at that level
    level_scale: float,
    frame_index: Tensor,  # (P,)
    intensity_left: Tensor,  # (P, N) grey levels, already brought to the right image's brightness
    centre: int,  # which neighbourhood pixel is the pixel itself
    offsets_px: Tensor,  # (n,) of the disparity, full-resolution pixels
) -> DisparityResiduals:
    """`photometric_residual` with the depth of every pixel moved to `depth / (1 + offset depth / (f b))`.

    A depth that an offset moves to infinity or beyond is not inside.
    """
    inverse_depth = 1 / depth + offsets_px[:, None] * lines.per_offset
    # (2, n, N, P): one tensor for u and v, and one for the depths.
    uv = torch.addcmul(lines.along_ray[:2, None], lines.along_baseline[:2, None], inverse_depth[:, None])
    z = torch.addcmul(lines.along_ray[2], lines.along_baseline[2], inverse_depth[:, None])
    in_front = (z.amin(dim=1) > 0) & (inverse_depth > 0)
    uv = uv * z.clamp_min(_LEAST_DEPTH_M).reciprocal()
    last_uv = (sizes - 1)[frame_index].to(uv.dtype).mT.flip(0)[:, None]
    on_image = all_along((uv.amin(dim=2) >= 0) & (uv.amax(dim=2) <= last_uv), dim=0)
    right = _lookup(image_right, frame_index, uv)
    residual = (right - intensity_left.mT).mT
    uv_right = (uv[:, :, centre] + 0.5) / level_scale - 0.5
    return DisparityResiduals(residual, in_front & on_image, uv_right.permute(1, 2, 0))


def _lookup(images: Tensor, frame_index: Tensor, uv: Tensor) -> Tensor:
    """Bilinear values (n, N, P) at pixels (2, n, N, P); the frames stand on top of one another: one call for all."""
    num_frames, height, width = images.shape
    # Filled on the device: a list would be copied there, and the host would wait.
    per_uv = torch.cat([uv.new_full((1,), 2 / width), uv.new_full((1,), 2 / (num_frames * height))])
    first = 0.5 * per_uv - 1
    # Two planes and not pairs: the lookup takes eight neighbours in one go from either, and planes need no shuffling.
    scale, start = per_uv.view(2, 1, 1, 1), first.view(2, 1, 1, 1)
    if num_frames > 1:
        below = torch.stack([torch.zeros_like(frame_index), frame_index * height])
        start = start + (below * per_uv[:, None])[:, None, None]
    grid = torch.addcmul(start, uv, scale).permute(1, 2, 3, 0)
    # One image for each offset, all the same memory: threads share the work by images. (Backward would make a gradient
    # of each; nothing here has one.)
    values = torch.nn.functional.grid_sample(
        images.reshape(1, 1, num_frames * height, width).expand(len(grid), -1, -1, -1),
        grid,
        mode="bilinear",
        padding_mode="border",
        align_corners=False,
    )
    return values.view(uv.shape[1:])
