"""This module casts any rays at one car, for pictures, reports and measurements."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.numerics.full_precision import full_precision
from directshape_torch.rows import Rays
from directshape_torch.shape.field import field_of
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.state.cars import CarState
from directshape_torch.terms.depth import closest_of_march, first_hits, march


class RayCast(NamedTuple):
    """This says what P rays meet."""

    closest_sdf: Tensor  # (P,) least signed distance along the ray, metres; infinite where it misses the prior's bounds
    depth: Tensor  # (P,) where it enters the car, metres of depth in its own camera; NaN where it passes by


@torch.no_grad()
@full_precision()
def cast(
    prior: ShapePrior,
    state: CarState,  # of one car
    centre_cam: Tensor,  # (3,) of the camera, or of each ray (P, 3), in the left camera's frame, metres
    ray_cam: Tensor,  # (P, 3) of unit depth, in the left camera's frame
    num_samples: int = 32,
) -> RayCast:
    """Cast rays at one car; each ray is a separate block."""
    owner = torch.zeros(len(ray_cam), dtype=torch.long, device=ray_cam.device)
    field = field_of(prior.bind(state.code))
    rays = Rays(owner, centre_cam.expand_as(ray_cam), ray_cam.mT[..., None]).in_objects(state.T_obj_cam)
    marched = march(field, owner, rays, prior.bounds_obj, num_samples)
    closest = closest_of_march(field, owner, rays, prior.bounds_obj, marched)
    hits = first_hits(field, owner, rays, marched, closest)
    sdf = torch.where(closest.crosses, field.sdf(closest.points_obj, owner), torch.inf)
    return RayCast(sdf[:, 0], torch.where(hits.found, hits.depth, torch.nan)[:, 0])
