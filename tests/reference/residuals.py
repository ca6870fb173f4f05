"""The residuals of the paper as its formulas say them, from packed pixels and a state; float64."""

from __future__ import annotations

import torch
from torch import Tensor

from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.terms.cars import CarState
from directshape_torch.terms.photometric import Photometric
from directshape_torch.terms.photometric_rows import DSO_PATTERN
from directshape_torch.terms.point_cloud import PointCloud
from directshape_torch.terms.silhouette import SATURATION, MaskRows, SilhouetteProducts, Silhouettes
from reference.rays import RaysObj, first_entry, least

# From the prior's bounds: so far away the closest approach stays of them, where the field has a kink.
MARGIN_M = 1e-4


def _rays(rows: MaskRows, state: CarState) -> RaysObj:
    size = rows.filled.shape[1]
    owner = rows.rays.owner.repeat_interleave(size)
    return RaysObj.of(
        state.T_obj_cam, owner, rows.rays.centre_cam.repeat_interleave(size, dim=0), rows.rays.ray_cam.flatten(1).mT
    )


def least_distance(prior: ShapePrior, rays: RaysObj, state: CarState) -> tuple[Tensor, Tensor]:
    """Least signed distance (P,) along rays, and whether they cross the prior's bounds."""
    lower, upper = prior.bounds_obj
    near, far, crosses = rays.interval(torch.stack([lower + MARGIN_M, upper - MARGIN_M]))
    near, far = torch.where(crosses, near, 1.0), torch.where(crosses, far, 2.0)
    distance = rays.along(prior.bind(state.code))
    return distance(least(distance, near, far)[:, None])[:, 0], crosses


def silhouette(prior: ShapePrior, term: Silhouettes, state: CarState) -> Tensor:
    """`-log(pi p_fg + (1 - pi) p_bg)` (M, R) with `pi = sigmoid(-zeta min sdf)`."""
    sdf, crosses = least_distance(prior, _rays(term.rows, state), state)
    foreground = term.rows.foreground
    exponent = (term.zeta * sdf.view_as(foreground)).clamp(-SATURATION, SATURATION)
    hit = torch.where(crosses.view_as(foreground), 1 / (1 + exponent.exp()), 0.0)
    return -(hit * foreground + (1 - hit) * (1 - foreground)).log()


def product(prior: ShapePrior, term: SilhouetteProducts, state: CarState, depths: Tensor, crosses: Tensor) -> Tensor:
    """The same (M, R) with `pi = 1 - prod_s 1 / (1 + exp(-zeta sdf_s))` over samples at constant depths (S, M, R)."""
    miss = torch.ones_like(term.rows.foreground)
    for depth in depths:
        sdf = _rays(term.rows, state).along(prior.bind(state.code))(depth.reshape(-1, 1)).view_as(miss)
        miss = miss / (1 + torch.exp(-term.zeta * sdf))
    hit = torch.where(crosses, 1 - miss, 0.0)
    foreground = term.rows.foreground
    return -(hit * foreground + (1 - hit) * (1 - foreground)).log()


def point_cloud(prior: ShapePrior, term: PointCloud, state: CarState) -> Tensor:
    """Signed distances (M, R) of the points."""
    points_cam, size = term.points_cam.ray_cam, term.filled.shape[1]
    owner = term.points_cam.owner.repeat_interleave(size)
    T = state.T_obj_cam[owner]
    points = (T[:, :3, :3] @ points_cam.flatten(1).mT[..., None])[..., 0] + T[:, :3, 3]
    return prior.bind(state.code).value(points, owner).view_as(term.filled)


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


def photometric(term: Photometric, level: int, depth: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Plain residuals (M, R, 8) at depths (M, R), without any match of brightness: `I_r(warp(p~, d_p)) - I_l(p~)`.

    Also the pixels (M, R, 8, 2) where the neighbours land in the right image, and their depth there.
    """
    images, fixed = term.left.pyramid[level], term.pixel_set
    residual = torch.zeros(*depth.shape, 8, dtype=depth.dtype)
    landed = torch.zeros(*depth.shape, 8, 2, dtype=depth.dtype)
    in_front = torch.zeros(*depth.shape, 8, dtype=depth.dtype)
    row = term.left.packed.row.flatten()[fixed.sight_place]
    for block, car in enumerate(fixed.blocks.owner.tolist()):
        frame, own = term.cars.frame_index[car], row[block]
        height, width = images.sizes[frame].tolist()
        left, right = (image[frame, :height, :width] for image in (images.left, images.right))
        for number, offset in enumerate(DSO_PATTERN):
            uv_level = (term.left.pixels.uv[own] + 0.5) * images.scale - 0.5 + torch.tensor(offset)
            homogeneous = torch.cat([(uv_level + 0.5) / images.scale - 0.5, torch.ones_like(uv_level[:, :1])], dim=1)
            point_left = depth[block, :, None] * (torch.linalg.inv(term.cars.K_left[car]) @ homogeneous.mT).mT
            T = term.cars.T_right_cam[car]
            x, y, z = (term.cars.K_right[car] @ (T[:3, :3] @ point_left.mT + T[:3, 3:])).unbind(0)
            u = (x / z - term.left.pixels.bias_px[own] + 0.5) * images.scale - 0.5
            v = (y / z + term.left.pixels.vertical_px[own] + 0.5) * images.scale - 0.5
            residual[block, :, number] = bilinear(right, u, v) - bilinear(left, *uv_level.unbind(1))
            landed[block, :, number], in_front[block, :, number] = torch.stack([u, v], dim=1), z
    return residual, landed, in_front
