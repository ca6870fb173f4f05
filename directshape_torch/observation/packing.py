"""Packed pixels of all cars: the one place where observations are gathered for the residuals.

Pixels are packed over cars and frames, sorted by object, because a near car has fifty times the pixels of a far one.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from directshape_torch.config import SamplingConfig
from directshape_torch.geometry.box3d import box_corners
from directshape_torch.geometry.pinhole import project, rays_from_pixels
from directshape_torch.geometry.stereo import right_rays, warp_to_right
from directshape_torch.image.gradients import gradient_magnitude, grey_levels, image_gradient
from directshape_torch.observation.occlusion import Side, hidden_pixels
from directshape_torch.observation.pixel_sampling import (
    PixelSelection,
    SamplingSettings,
    cell_thresholds,
    cells_of_regions,
    region_boxes,
    sample_pixels,
)
from directshape_torch.scene import Detections, FrameBatch


@dataclass(frozen=True)
class PixelSamples:
    """P pixels of one image side, sorted by object.

    Attributes:
        object_index: (P,) ascending.
        uv: (P, 2) pixels.
        origin_cam: (P, 3) camera centre of the pixel's own camera, in the left camera frame, metres.
        ray_cam: (P, 3) direction of unit depth in the pixel's own camera, in the left camera frame.
        foreground: (P,) probability in [0, 1] of the mask at the pixel.
        gradient_magnitude: (P,) grey levels per pixel.
        bias_px: (P,) residual disparity at the (corresponding) left pixel, zero without a field.
        vertical_px: (P,) residual row offset there, zero without a field.
    """

    object_index: Tensor
    uv: Tensor
    origin_cam: Tensor
    ray_cam: Tensor
    foreground: Tensor
    gradient_magnitude: Tensor
    bias_px: Tensor
    vertical_px: Tensor

    def __len__(self) -> int:
        return len(self.object_index)

    def select(self, index: Tensor) -> PixelSamples:
        """Some of the pixels."""
        return replace(self, **{f.name: getattr(self, f.name)[index] for f in fields(self)})

    def of_objects(self, keep: Tensor) -> PixelSamples:
        """The pixels of the objects where `keep` (B,) holds, renumbered."""
        new_number = torch.cumsum(keep.long(), 0) - 1
        chosen = self.select(keep[self.object_index].nonzero()[:, 0])
        return replace(chosen, object_index=new_number[chosen.object_index])


@dataclass(frozen=True)
class Observation:
    """Everything that B cars see of the images.

    Attributes:
        left, right: packed pixels of the two images.
        region_left, region_right: (B, 4) integer regions (u0, v0, u1, v1), half open, pixels.
    """

    left: PixelSamples
    right: PixelSamples
    region_left: Tensor
    region_right: Tensor


def pack_pixels(frames: FrameBatch, detections: Detections, config: SamplingConfig) -> Observation:
    """Choose the pixels of every car in both images and gather what the residuals need of them.

    Args:
        frames: F frames.
        detections: B cars, whose initial poses fix regions and correspondence for the disparity field.
        config: density, regions, occlusion.
    """
    regions = _regions(frames, detections, config)
    left = _pack_side(frames, detections, "left", regions[0], config)
    right = _pack_side(frames, detections, "right", regions[1], config)
    return Observation(left, right, *regions)


def residual_offsets(frames: FrameBatch, uv_left: Tensor) -> tuple[Tensor, Tensor]:
    """Residual disparity and row offset (P,) at left pixels (P, 2); zero without a field."""
    field = frames.camera.disparity_field
    if field is None:
        zero = torch.zeros_like(uv_left[..., 0])
        return zero, zero
    return field.bias(uv_left), field.vertical(uv_left)


def projected_box_right(frames: FrameBatch, detections: Detections) -> Tensor:
    """Bounding boxes (B, 4) of the initial 3D boxes in the right image, NaN for those not wholly in front of it."""
    camera = frames.camera
    f = detections.frame_index
    corners_cam = box_corners(detections.T_cam_obj, detections.dimensions_hwl)
    K_left = camera.K_left[f][:, None]
    uv_left = project(corners_cam, K_left)
    right = warp_to_right(
        rays_from_pixels(uv_left, K_left),
        corners_cam[..., 2],
        camera.K_right[f][:, None],
        camera.T_right_cam[f][:, None],
        *residual_offsets(frames, uv_left),
    )
    uv = right.uv_right
    box = torch.cat([uv.amin(dim=1), uv.amax(dim=1)], dim=1)
    in_front = ((corners_cam[..., 2] > 0.1) & right.in_front).all(dim=1)
    return torch.where(in_front[:, None], box, torch.full_like(box, torch.nan))


def select_pixels(
    magnitude: Tensor,  # (F, H, W) grey levels per pixel
    sizes: Tensor,  # (F, 2)
    frame_index: Tensor,  # (B,)
    regions: Tensor,  # (B, 4)
    config: SamplingConfig,
) -> PixelSelection:
    """Both rounds of the adaptive sampling, with thresholds only where cars are."""
    settings = SamplingSettings(config.mode, config.density, config.min_pixels, config.max_pixels)
    num_frames, height, width = magnitude.shape
    needed = cells_of_regions(regions, frame_index, (num_frames, height, width), settings)
    thresholds = cell_thresholds(magnitude, sizes, needed, settings)
    return sample_pixels(magnitude, thresholds, regions, frame_index, settings)


def _regions(frames: FrameBatch, d: Detections, config: SamplingConfig) -> tuple[Tensor, Tensor]:
    sizes = frames.sizes[d.frame_index]
    margins = {"margin_px": config.region_margin_px, "margin_share": config.region_margin_share}
    left = region_boxes(d.box_2d, d.mask_left, d.has_mask_left, sizes, join=True, **margins)
    right = region_boxes(projected_box_right(frames, d), d.mask_right, d.has_mask_right, sizes, join=False, **margins)
    # Without a mask a side says nothing about the car.
    return left * d.has_mask_left[:, None], right * d.has_mask_right[:, None]


def _pack_side(
    frames: FrameBatch, detections: Detections, side: Side, regions: Tensor, config: SamplingConfig
) -> PixelSamples:
    left = side == "left"
    grey = grey_levels(frames.images_left if left else frames.images_right)
    magnitude = gradient_magnitude(image_gradient(grey, frames.sizes))
    chosen = select_pixels(magnitude, frames.sizes, detections.frame_index, regions, config)
    object_index, uv = chosen.object_index, chosen.uv
    if config.occlusion:
        visible = ~hidden_pixels(detections, side, object_index, uv, config.occlusion_order)
        object_index, uv = object_index[visible], uv[visible]
    frame = detections.frame_index[object_index]
    mask = detections.mask_left if left else detections.mask_right
    dtype = grey.dtype
    uv_float = uv.to(dtype)
    rays = _rays_left(frames, detections, object_index, uv_float) if left else _rays_right(
        frames, detections, object_index, uv_float
    )  # fmt: skip
    return PixelSamples(
        object_index=object_index,
        uv=uv_float,
        origin_cam=rays[0],
        ray_cam=rays[1],
        foreground=mask[object_index, uv[:, 1], uv[:, 0]].to(dtype),
        gradient_magnitude=magnitude[frame, uv[:, 1], uv[:, 0]],
        bias_px=rays[2][0],
        vertical_px=rays[2][1],
    )


def _rays_left(
    frames: FrameBatch, detections: Detections, object_index: Tensor, uv: Tensor
) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor]]:
    K = frames.camera.K_left[detections.frame_index[object_index]]
    ray = rays_from_pixels(uv, K)
    return torch.zeros_like(ray), ray, residual_offsets(frames, uv)


def _rays_right(
    frames: FrameBatch, detections: Detections, object_index: Tensor, uv: Tensor
) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor]]:
    """The corresponding left pixel is the one at the car's INPUT depth: frozen per car, so moving does not pay."""
    camera = frames.camera
    frame = detections.frame_index[object_index]
    z_input = detections.T_cam_obj[object_index, 2, 3]
    shift = camera.K_left[frame, 0, 0] * camera.baseline[frame] / z_input
    uv_left = torch.stack([uv[:, 0] + shift, uv[:, 1]], dim=-1)
    offsets = residual_offsets(frames, uv_left)
    rays = right_rays(uv, camera.K_right[frame], camera.T_right_cam[frame], *offsets)
    return rays.origin_cam, rays.direction_cam, offsets
