"""This module computes the residuals of the paper by its formulas, from packed pixels and a state; float64."""

from __future__ import annotations

import torch
from torch import Tensor

from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.state.cars import CarState
from directshape_torch.terms.photometric import Photometric
from directshape_torch.terms.photometric_rows import DSO_PATTERN, LeftPixels
from reference.rays import RaysObj, first_entry

# From the prior's bounds: so far away the closest approach stays of them, where the field has a kink.
MARGIN_M = 1e-4


def surface_depth(prior: ShapePrior, term: Photometric, state: CarState) -> tuple[Tensor, Tensor]:
    """Depth (M, R) of the surface under the pixels of the set, and whether there is one."""
    rows = term.pixel_set.rows
    owner = rows.rays.owner.repeat_interleave(rows.pixel_weight.shape[1])
    ray_cam = rows.rays.ray_cam.flatten(1).mT
    rays = RaysObj.of(state.T_obj_cam, owner, torch.zeros_like(ray_cam), ray_cam)
    depth, found = first_entry(rays, prior.bind(state.code), prior.bounds_obj)
    return depth.view_as(rows.pixel_weight), found.view_as(rows.pixel_weight)


def bilinear(image: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Grey levels (...) of an image (H, W) at pixels (...)."""
    u0, v0 = u.floor().clamp(0, image.shape[1] - 2), v.floor().clamp(0, image.shape[0] - 2)
    a, b = u - u0, v - v0  # NaN where nothing is looked up
    column, row = u0.nan_to_num().long(), v0.nan_to_num().long()
    upper = (1 - a) * image[row, column] + a * image[row, column + 1]
    lower = (1 - a) * image[row + 1, column] + a * image[row + 1, column + 1]
    return (1 - b) * upper + b * lower


def photometric(term: Photometric, pixels: LeftPixels, level: int, depth: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Plain residuals (M, R, 8) at depths (M, R), without any match of brightness: `I_r(warp(p~, d_p)) - I_l(p~)`.

    Further results are the pixels (M, R, 8, 2) of the neighbours in the right image, and their depth there.
    """
    images, fixed = pixels.pyramid[level], term.pixel_set
    residual = torch.zeros(*depth.shape, 8, dtype=depth.dtype)
    landed = torch.zeros(*depth.shape, 8, 2, dtype=depth.dtype)
    in_front = torch.zeros(*depth.shape, 8, dtype=depth.dtype)
    row = pixels.packed.row.flatten()[fixed.prepared_place]
    for block, car in enumerate(fixed.blocks.owner.tolist()):
        frame, own = term.cars.frame_index[car], row[block]
        height, width = images.sizes[frame].tolist()
        left, right = (image[frame, :height, :width] for image in (images.left, images.right))
        for number, offset in enumerate(DSO_PATTERN):
            uv_level = (pixels.pixels.uv[own] + 0.5) * images.scale - 0.5 + torch.tensor(offset)
            homogeneous = torch.cat([(uv_level + 0.5) / images.scale - 0.5, torch.ones_like(uv_level[:, :1])], dim=1)
            point_left = depth[block, :, None] * (torch.linalg.inv(term.cars.K_left[car]) @ homogeneous.mT).mT
            T = term.cars.T_right_cam[car]
            x, y, z = (term.cars.K_right[car] @ (T[:3, :3] @ point_left.mT + T[:3, 3:])).unbind(0)
            u = (x / z - pixels.pixels.bias_px[own] + 0.5) * images.scale - 0.5
            v = (y / z + pixels.pixels.vertical_px[own] + 0.5) * images.scale - 0.5
            residual[block, :, number] = bilinear(right, u, v) - bilinear(left, *uv_level.unbind(1))
            landed[block, :, number], in_front[block, :, number] = torch.stack([u, v], dim=1), z
    return residual, landed, in_front
