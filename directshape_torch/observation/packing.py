"""Packed pixels of all cars: the one place where observations are gathered for the residuals.

Pixels are packed over cars and frames, sorted by object, because a near car has fifty times the pixels of a far one.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.config import SamplingConfig
from directshape_torch.geometry.pinhole import rays_from_pixels
from directshape_torch.geometry.stereo import right_rays
from directshape_torch.observation.gradient_tiles import gradient_tiles
from directshape_torch.observation.mask_extents import SceneExtents, scene_extents
from directshape_torch.observation.occlusion import OcclusionCrops, Side, crops_of_sides
from directshape_torch.observation.pixel_sampling import candidate_pixels
from directshape_torch.observation.regions import RegionPixels, region_boxes
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
        mask_areas: (detections of the call, 2) foreground pixels of the left and right masks, 0 where absent.
    """

    left: PixelSamples
    right: PixelSamples
    region_left: Tensor
    region_right: Tensor
    hidden_right: OcclusionCrops | None
    mask_areas: Tensor

    def of_objects(self, keep: Tensor) -> Observation:
        """What the objects where `keep` (B,) holds see; occlusion and areas stay those of all detections."""
        return replace(
            self,
            left=self.left.of_objects(keep),
            right=self.right.of_objects(keep),
            region_left=self.region_left[keep],
            region_right=self.region_right[keep],
        )


def pack_pixels(
    frames: FrameBatch, detections: Detections, config: SamplingConfig, extents: SceneExtents | None = None
) -> Observation:
    """Choose the pixels of every car in both images and gather what the residuals need of them.

    Both images are treated as one: cars 0 .. B-1 are those of the left image, B .. 2B-1 those of the right one.

    Args:
        frames: F frames.
        detections: B cars, whose initial poses fix regions and correspondence for the disparity field.
        config: density, regions, occlusion.
        extents: of the masks of these detections, where they are known already.
    """
    extents = scene_extents(detections) if extents is None else extents
    regions = car_regions(frames, detections, config, extents)
    both, hidden = torch.cat(regions), None
    if config.occlusion:
        hidden = crops_of_sides(detections, ("left", "right"), extents, both, len(frames), config.occlusion_order)
    left, right = _chosen_pixels(frames, detections, both, hidden, config)
    if hidden is not None:
        strips = _strips_in_right_image(regions[0], frames.sizes[detections.frame_index])
        hidden = hidden.objects(slice(len(detections), None)).within(strips)
    return Observation(
        _pack_side(frames, detections, "left", left),
        _pack_side(frames, detections, "right", right),
        *regions,
        hidden,
        extents.areas(),
    )


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


def car_regions(
    frames: FrameBatch, d: Detections, config: SamplingConfig, extents: SceneExtents | None = None
) -> tuple[Tensor, Tensor]:
    """Regions (B, 4) of the cars in the left and the right image, integer (u0, v0, u1, v1), half open."""
    extents = scene_extents(d) if extents is None else extents
    # Only the left image has detection boxes. A side without a mask says nothing about the car: no pixels there.
    left, right = region_boxes(
        torch.cat([d.box_2d, torch.full_like(d.box_2d, torch.nan)]),
        torch.cat([extents.left.boxes, extents.right.boxes]),
        frames.sizes[d.frame_index].repeat(2, 1),
        join=True,
        margin_px=config.region_margin_px,
        margin_share=config.region_margin_share,
    ).tensor_split(2)
    return left * d.has_mask_left[:, None], right


class _Chosen(NamedTuple):
    """P pixels of one image."""

    object_index: Tensor  # (P,)
    uv: Tensor  # (P, 2) integer
    gradient_magnitude: Tensor  # (P,)


def _chosen_pixels(
    frames: FrameBatch, detections: Detections, regions: Tensor, hidden: OcclusionCrops | None, config: SamplingConfig
) -> tuple[_Chosen, _Chosen]:
    """The visible ones of the pixels that `select_pixels` chooses, of the regions (2 B, 4) of both images."""
    settings = sampling_settings(config)
    frame = torch.cat([detections.frame_index, detections.frame_index + len(frames)])
    tiles = gradient_tiles((frames.images_left, frames.images_right), frames.sizes, regions, frame, settings)
    pixels = RegionPixels.of(regions, settings.threshold_cell_px)
    entry, threshold = tiles.entries_and_thresholds(pixels, frame)
    magnitudes = tiles.magnitude.flatten()
    magnitude = magnitudes.detach().index_select(0, entry)
    above = magnitude.float() > threshold.float()
    index, exists = candidate_pixels(pixels, regions, magnitude, above, settings)
    object_index, uv = pixels.uv_of(index)
    if hidden is not None:
        exists = exists & ~hidden.at(object_index, uv)
    kept = exists.nonzero()[:, 0]
    object_index, uv = object_index.index_select(0, kept), uv.index_select(0, kept)
    magnitude = magnitudes.index_select(0, entry.index_select(0, index.index_select(0, kept)))
    num_left = int((object_index < len(detections)).sum())
    return (
        _Chosen(object_index[:num_left], uv[:num_left], magnitude[:num_left]),
        _Chosen(object_index[num_left:] - len(detections), uv[num_left:], magnitude[num_left:]),
    )


def _pack_side(frames: FrameBatch, detections: Detections, side: Side, chosen: _Chosen) -> PixelSamples:
    left = side == "left"
    object_index, uv = chosen.object_index, chosen.uv
    mask = detections.mask_left if left else detections.mask_right
    dtype = frames.images_left.dtype
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
        gradient_magnitude=chosen.gradient_magnitude,
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
