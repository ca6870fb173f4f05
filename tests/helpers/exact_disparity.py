"""The disparity map of the synthetic street, ray cast and exact to rounding."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import torch
from reference.rays import RaysObj, first_entry
from torch import Tensor

from directshape_torch.geometry import se3
from directshape_torch.geometry.camera import rays_from_pixels
from directshape_torch.geometry.projection import disparity_of_depth
from directshape_torch.scene import FrameBatch
from directshape_torch.shape.pca_prior import PCAShapePrior
from helpers.synthetic_scene import Street, cached_street


def exact_disparity(prior: PCAShapePrior, scene: Street) -> Tensor:
    """(1, H, W) pixels; NaN where no car is."""
    camera = scene.frames.camera
    height, width = scene.frames.images_left.shape[2:]
    v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    uv = torch.stack([u, v], dim=-1).reshape(-1, 2).to(prior.origin)
    rays_cam = rays_from_pixels(uv, camera.K_left)
    shape, depth = prior.bind(scene.code), torch.full_like(uv[:, 0], torch.inf)
    for i in range(len(scene.code)):
        car = torch.full_like(depth, i, dtype=torch.long)
        rays = RaysObj.of(se3.inverse(scene.detections.T_cam_obj), car, torch.zeros_like(rays_cam), rays_cam)
        of_car, found = first_entry(rays, shape, prior.bounds_obj)
        depth = torch.where(found & (of_car < depth), of_car, depth)
    disparity = disparity_of_depth(uv, depth, camera.K_left[0], camera.K_right[0], camera.T_right_cam[0])[:, 0]
    return torch.where(depth.isfinite(), disparity, torch.nan).view(1, height, width)


@lru_cache(maxsize=2)
def measured_street(dtype: torch.dtype = torch.float64) -> tuple[PCAShapePrior, Street]:
    """The two-car street whose frames bring their exact disparity."""
    prior, scene = cached_street(dtype)
    frames: FrameBatch = replace(scene.frames, disparity=exact_disparity(prior, scene))
    return prior, replace(scene, frames=frames)
