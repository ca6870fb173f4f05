"""Packed pixels of all cars: the one place where observations are gathered for the residuals.

Pixels are packed over cars and frames, sorted by object, because a near car has fifty times the pixels of a far one.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from directshape_torch.config import SamplingConfig
from directshape_torch.geometry.pinhole import rays_from_pixels
from directshape_torch.geometry.stereo import right_rays
from directshape_torch.image.gradients import gradient_magnitude, grey_levels, image_gradient
from directshape_torch.observation.occlusion import OcclusionCrops, Side, hidden_pixels, occlusion_crops
from directshape_torch.observation.pixel_sampling import select_pixels
from directshape_torch.observation.regions import region_boxes
from directshape_torch.observation.sampling_settings import SamplingSettings
from directshape_torch.scene import Detections, FrameBatch

# Rows that a warped neighbourhood may leave its region by: the pattern on a coarse level, and cameras not quite in row.
_ROW_MARGIN_PX = 8


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
        hidden_right: where nearer instances cover the right image, by row of the detections; None: not asked for.
    """

    left: PixelSamples
    right: PixelSamples
    region_left: Tensor
    region_right: Tensor
    hidden_right: OcclusionCrops | None

    def of_objects(self, keep: Tensor) -> Observation:
        """What the objects where `keep` (B,) holds see; `hidden_right` stays that of all detections."""
        return replace(
            self,
            left=self.left.of_objects(keep),
            right=self.right.of_objects(keep),
            region_left=self.region_left[keep],
            region_right=self.region_right[keep],
        )


def pack_pixels(frames: FrameBatch, detections: Detections, config: SamplingConfig) -> Observation:
    """Choose the pixels of every car in both images and gather what the residuals need of them.

    Args:
        frames: F frames.
        detections: B cars, whose initial poses fix regions and correspondence for the disparity field.
        config: density, regions, occlusion.
    """
    regions = car_regions(frames, detections, config)
    left = _pack_side(frames, detections, "left", regions[0], config)
    right = _pack_side(frames, detections, "right", regions[1], config)
    hidden = None
    if config.occlusion:
        strips = _strips_in_right_image(regions[0], frames.sizes[detections.frame_index])
        hidden = occlusion_crops(detections, "right", strips, config.occlusion_order)
    return Observation(left, right, *regions, hidden)


def _strips_in_right_image(region_left: Tensor, sizes: Tensor) -> Tensor:
    """Where pixels of the left regions can land in the right image at any depth: their rows, and a few more."""
    u0, v0, u1, v1 = region_left.unbind(-1)
    height, width = sizes.unbind(-1)
    strips = torch.stack(
        [torch.zeros_like(u0), (v0 - _ROW_MARGIN_PX).clamp_min(0), width, torch.minimum(v1 + _ROW_MARGIN_PX, height)],
        dim=-1,
    )
    return strips * (u1 > u0)[:, None]


def residual_offsets(frames: FrameBatch, uv_left: Tensor) -> tuple[Tensor, Tensor]:
    """Residual disparity and row offset (P,) at left pixels (P, 2); zero without a field."""
    field = frames.camera.disparity_field
    if field is None:
        zero = torch.zeros_like(uv_left[..., 0])
        return zero, zero
    return field.bias(uv_left), field.vertical(uv_left)


def sampling_settings(config: SamplingConfig) -> SamplingSettings:
    """The part of the configuration that chooses pixels within a region."""
    return SamplingSettings(config.mode, config.density, config.min_pixels, config.max_pixels)


def car_regions(frames: FrameBatch, d: Detections, config: SamplingConfig) -> tuple[Tensor, Tensor]:
    """Regions (B, 4) of the cars in the left and the right image, integer (u0, v0, u1, v1), half open."""
    sizes = frames.sizes[d.frame_index]
    margins = {"margin_px": config.region_margin_px, "margin_share": config.region_margin_share}
    left = region_boxes(d.box_2d, d.mask_left, d.has_mask_left, sizes, join=True, **margins)
    # Only the left image has detection boxes. A side without a mask says nothing about the car: no pixels there.
    nowhere = torch.full_like(d.box_2d, torch.nan)
    right = region_boxes(nowhere, d.mask_right, d.has_mask_right, sizes, join=False, **margins)
    return left * d.has_mask_left[:, None], right


def _pack_side(
    frames: FrameBatch, detections: Detections, side: Side, regions: Tensor, config: SamplingConfig
) -> PixelSamples:
    left = side == "left"
    grey = grey_levels(frames.images_left if left else frames.images_right)
    magnitude = gradient_magnitude(image_gradient(grey, frames.sizes))
    chosen = select_pixels(magnitude, frames.sizes, detections.frame_index, regions, sampling_settings(config))
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
    shift = shift + camera.K_left[frame, 0, 2] - camera.K_right[frame, 0, 2]
    uv_left = torch.stack([uv[:, 0] + shift, uv[:, 1]], dim=-1)
    offsets = residual_offsets(frames, uv_left)
    rays = right_rays(uv, camera.K_right[frame], camera.T_right_cam[frame], *offsets)
    return rays.origin_cam, rays.direction_cam, offsets
