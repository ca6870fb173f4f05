"""This module compares pixels of the left image with the right one; one depth warps the neighbourhood of each pixel.

The warp of a neighbour is a line in homogeneous pixels, `along_ray depth + along_baseline`. The line contains the
cameras, the rig's residual field and the pyramid level, so a comparison at any depth needs a few products and a lookup.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from directshape_torch.config import PhotometricConfig
from directshape_torch.image.grey_levels import GreyPair
from directshape_torch.image.interpolate import BilinearPatch, bilinear_patch
from directshape_torch.kernels.arguments import Comparison, Pixels, singles
from directshape_torch.kernels.choice import array
from directshape_torch.numerics.records import Dense
from directshape_torch.numerics.tables import Table
from directshape_torch.numerics.tensors import all_along, made_once
from directshape_torch.rows import OcclusionMap, PixelSamples, Rays, Rows
from directshape_torch.scene.masks import MASK_THRESHOLD, MaskCrops
from directshape_torch.state.cars import CarBatch

# This is DSO's pattern of 8 neighbourhood pixels (Engel et al., Direct Sparse Odometry, fig. 4), as (du, dv).
DSO_PATTERN: tuple[tuple[int, int], ...] = ((0, -2), (-1, -1), (1, -1), (-2, 0), (0, 0), (2, 0), (-1, 1), (0, 2))
CENTRE = DSO_PATTERN.index((0, 0))
# This is c of the gradient weight c^2 / (c^2 + |grad I_l|^2) (DSO), in grey levels per pixel.
GRADIENT_CONSTANT = 50.0
# The right camera sees only points with at least this depth.
LEAST_DEPTH_M = 1e-6


@made_once
def _pattern(dtype: torch.dtype, device: torch.device) -> Tensor:
    """`DSO_PATTERN` as a tensor (2, N, 1, 1)."""
    return torch.tensor(DSO_PATTERN, dtype=dtype, device=device).mT[..., None, None]


class PhotometricRows(NamedTuple):
    """`PhotometricRows` are the pixels of a stage in M blocks of 64, each pixel with N neighbours."""

    rays: Rays
    # homogeneous right pixel (at the pyramid level) per metre of depth, and at depth zero
    along_ray: Annotated[Tensor, Dense(3, "N", "M", 64)]
    along_baseline: Annotated[Tensor, Dense(3, "M", 64)]
    intensity_left: Annotated[Tensor, Dense("N", "M", 64)]  # grey levels, brought to the brightness of the right image
    pixel_weight: Annotated[Tensor, Dense("M", 64)]  # by the gradient; zero in empty places and outside of the set
    neighbour_weight: Annotated[Tensor, Dense("N", "M", 64)]  # zero for neighbours that the mask excludes from the car
    right: RightView


class RightView(NamedTuple):
    """A `RightView` holds, for each block, the right image of its frame and where nearer instances hide its car."""

    pixels: Annotated[Tensor, Dense("A")]  # grey levels of all frames at the pyramid level, one after another
    # first pixel of the block's frame, pixels per row, last column, last row
    frame: Annotated[Tensor, Dense("M", 4, kind="index")]
    # full-resolution pixels per level pixel, and full-resolution position of level pixel 0
    to_full: Annotated[Tensor, Dense("M", 2)]
    crop: Annotated[Tensor, Dense("M", 6, kind="index")]  # where the car is looked up in an `OcclusionMap`
    in_front: Annotated[Tensor, Dense("M", 2)]  # an instance hides the car if its value in `covering` is below this
    covering: Annotated[Tensor, Dense("A", 2)]  # the foremost instances of the `OcclusionMap`


@dataclass(frozen=True)
class LeftPixels(Table):
    """`LeftPixels` holds all packed pixels of the left image and both images; pixel sets are made from it."""

    pixels: PixelSamples  # P packed pixels
    packed: Rows  # how the pixels fill the blocks of a `Prepared`
    pyramid: tuple[GreyPair, ...]  # both images at every level that a stage asks for
    hidden_right: OcclusionMap | None  # where nearer instances cover the right image; None: nowhere
    mask_left: MaskCrops  # masks of the detections of the call

    @property
    def rays(self) -> Rays:
        """The rays of the blocks of a `Prepared`."""
        return Rays.of_rows(self.packed, self.pixels.origin_cam, self.pixels.ray_cam)

    def rows(
        self, config: PhotometricConfig, cars: CarBatch, packed: Rows, row: Tensor, image_level: int
    ) -> PhotometricRows:
        """The pixels in `row` (M, 64), with the left part of their residuals."""
        owner, images = packed.blocks.owner, self.pyramid[image_level]
        frame = cars.frame_index[owner]
        uv_level = (self.pixels.uv[row].movedim(-1, 0)[:, None] + 0.5) * images.scale - 0.5 + _pattern(self.pixels.uv)
        view = frame_view(images, frame)
        u_level, v_level = uv_level
        intensity = bilinear_patch(images.left.reshape(-1), *view[:2], u_level, v_level, *view[2:]).value
        uv_full = (uv_level + 0.5) / images.scale - 0.5
        K = cars.K_left[owner][..., None]  # (M, 3, 3, 1)
        v = (uv_full[1] - K[:, 1, 2]) / K[:, 1, 1]
        u = (uv_full[0] - K[:, 0, 2] - K[:, 0, 1] * v) / K[:, 0, 0]
        along_ray, along_baseline = self._warp_lines(cars, owner, row, images.scale, u, v)
        c2 = GRADIENT_CONSTANT**2
        weight = c2 / (c2 + self.pixels.gradient_magnitude[row] ** 2)
        neighbours = torch.ones_like(intensity)
        if config.pixel_set != "hit":  # the paper's set keeps neighbours outside the car
            neighbours = self._neighbours_on_car(cars, owner, *uv_full)
        return PhotometricRows(
            Rays.of_rows(packed._replace(row=row), self.pixels.origin_cam, self.pixels.ray_cam),
            along_ray,
            along_baseline,
            intensity,
            weight,
            neighbours,
            self._right_view(cars, images, frame, owner),
        )

    def _warp_lines(
        self, cars: CarBatch, owner: Tensor, row: Tensor, scale: float, u: Tensor, v: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the warp of each neighbour as a line in homogeneous level pixels, `along_ray depth + along_baseline`.

        The line contains the cameras, the rig's residual field and the level: an image point lies at
        `u_right = pinhole - bias`, `v_right = pinhole + vertical`.
        """
        pinhole = (cars.K_right @ cars.T_right_cam[:, :3])[owner].permute(1, 2, 0)[..., None]  # (3, 4, M, 1)
        shift_u, shift_v = 0.5 - self.pixels.bias_px[row], 0.5 + self.pixels.vertical_px[row]
        last = pinhole[2]
        line = torch.stack(
            [
                scale * pinhole[0] + (shift_u * scale - 0.5) * last,
                scale * pinhole[1] + (shift_v * scale - 0.5) * last,
                last.expand(-1, *row.shape),
            ]
        )  # (3, 4, M, 64)
        return line[:, 0, None] * u + line[:, 1, None] * v + line[:, 2, None], line[:, 3]

    def _neighbours_on_car(self, cars: CarBatch, owner: Tensor, u: Tensor, v: Tensor) -> Tensor:
        """Return weights (N, M, 64): one for neighbours on the mask of the car, zero for others.

        All neighbours are warped with the depth of the centre, so background next to the contour would pull the depth
        of a small car away from its surface.
        """
        last_row, last_column = (self.pyramid[0].sizes[cars.frame_index[owner]] - 1)[:, :, None].unbind(1)
        inside = (u >= -0.5) & (v >= -0.5) & (u <= last_column + 0.5) & (v <= last_row + 0.5)
        return (inside & is_on_mask(self.mask_left, cars.detection_row[owner], u, v)).to(u.dtype)

    def _right_view(self, cars: CarBatch, images: GreyPair, frame: Tensor, owner: Tensor) -> RightView:
        per_level = 1 / images.scale
        to_full = images.right.new_full((len(owner), 2), per_level)
        to_full[:, 1] = 0.5 * per_level - 0.5
        view = torch.cat(frame_view(images, frame), dim=1)
        hidden, row = self.hidden_right, cars.detection_row[owner]
        if hidden is None:
            nowhere = torch.zeros(len(owner), 6, dtype=torch.long, device=owner.device)
            covered = nowhere, view.new_zeros(len(owner), 2), view.new_zeros(1, 2)
        else:
            covered = hidden.crop[row], hidden.in_front[row], hidden.covering
        return RightView(images.right.reshape(-1), view, to_full, *covered)


def is_on_mask(mask_left: MaskCrops, row: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Whether points (..., M, 64), clamped to the left image, are on the masks of the detections in rows (M,)."""
    height, width = mask_left.size_hw
    at_u, at_v = (x.round().long().clamp(0, last - 1) for x, last in ((u, width), (v, height)))
    return mask_left.at(row[:, None], at_u, at_v) > MASK_THRESHOLD


def frame_view(images: GreyPair, frame: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """First pixel, pixels per row, last column and last row of frames (M,), (M, 1) each."""
    _, height, width = images.right.shape
    last_row, last_column = (images.sizes[frame] - 1).unbind(1)
    columns = frame * (height * width), torch.full_like(frame, width), last_column, last_row
    first, step, last_u, last_v = (x.int()[:, None] for x in columns)
    return first, step, last_u, last_v


def compared(rows: PhotometricRows, depth: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Residuals (M, 64, N) at depths (M, 64), derivatives by the depth, and a mask (M, 64) of comparable pixels.

    All neighbours are warped with the depth of their pixel.
    """
    warped = warped_pixels(rows, depth)
    along, at = rows.along_ray, warped.at
    d_u = torch.addcmul(along[0], warped.u, along[2], value=-1) * warped.inverse_z
    d_v = torch.addcmul(along[1], warped.v, along[2], value=-1) * warped.inverse_z
    J = (at.d_u * d_u + at.d_v * d_v).movedim(-3, -1)
    return warped.residual(rows), J, warped.is_comparable(rows.right)


def residuals_at(rows: PhotometricRows, depth: Tensor) -> tuple[Tensor, Tensor]:
    """Differentiable residuals (..., M, 64, N) at depths (..., M, 64), and a mask (..., M, 64) of comparable pixels."""
    warped = warped_pixels(rows, depth)
    return warped.residual(rows), warped.is_comparable(rows.right)


def comparison(config: PhotometricConfig) -> Comparison:
    """The constants of native loops."""
    return Comparison(*(*singles(config.lost_grey_levels, config.huber_grey_levels, LEAST_DEPTH_M), CENTRE))


def pixel_arrays(rows: PhotometricRows) -> Pixels:
    """The pixels for native loops."""
    return Pixels(*map(array, (*rows[1:-1], *rows.right)))


class Warped(NamedTuple):
    """`Warped` holds neighbours (..., N, M, 64) in the right image, at the pyramid level."""

    u: Tensor
    v: Tensor
    inverse_z: Tensor
    in_front: Tensor
    at: BilinearPatch

    def residual(self, rows: PhotometricRows) -> Tensor:
        """Right minus left grey levels (..., M, 64, N)."""
        return (self.at.value - rows.intensity_left).movedim(-3, -1)

    def is_comparable(self, right: RightView) -> Tensor:
        """Mask (..., M, 64) of pixels that are visible in the right image and whose neighbours all land in it."""
        inside = all_along(self.at.inside & self.in_front, dim=-3)
        u, v = (x[..., CENTRE, :, :].detach() for x in (self.u, self.v))
        return inside & ~_is_hidden(right, u, v)


def warped_pixels(rows: PhotometricRows, depth: Tensor) -> Warped:
    """The neighbours of pixels at depths (..., M, 64), looked up where they land."""
    depth = depth.unsqueeze(-3)
    x, y, z = (torch.addcmul(at, along, depth) for at, along in zip(rows.along_baseline, rows.along_ray, strict=True))
    in_front = z > LEAST_DEPTH_M
    inverse = 1 / torch.where(in_front, z, 1.0)
    u, v = x * inverse, y * inverse
    first_pixel, row_step, last_column, last_row = rows.right.frame.mT[..., None]
    at = bilinear_patch(rows.right.pixels, first_pixel, row_step, u, v, last_column, last_row)
    return Warped(u, v, inverse, in_front, at)


def _is_hidden(right: RightView, u_level: Tensor, v_level: Tensor) -> Tensor:
    """Whether a nearer instance hides the car at pixels (..., M, 64) of its right image (`OcclusionMap.at`)."""
    scale, first = right.to_full.mT[..., None]
    u, v = (torch.round(torch.addcmul(first, x, scale)) for x in (u_level, v_level))
    u0, v0, u1, v1, entry, width = right.crop.mT[..., None]
    inside = (u >= u0) & (u < u1) & (v >= v0) & (v < v1)
    column, row = (torch.where(inside, x, torch.zeros_like(x)).long() for x in (u, v))
    entry = torch.where(inside, entry + row * width + column, 0)
    covering = right.covering.index_select(0, entry.reshape(-1)).view(*entry.shape, 2)
    covered: Tensor = (covering < right.in_front[:, None]).any(dim=-1) & inside
    return covered
