"""The lookups of signed distance that a Gauss-Newton iteration cannot avoid, as points to look up.

A pixel whose contour is in play must know the least distance along its ray: the point of the last state is corrected
(one value with its gradient), and there value, gradient and code derivative make residual and Jacobian. A pixel of the
photometric set must know its depth: the same two. Pixels that are certain, and everything else, need none.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from directshape_torch.config import RefinerConfig
from directshape_torch.energy.car_batch import CarBatch
from directshape_torch.energy.car_state import CarState
from directshape_torch.geometry.rays import ray_box_interval
from directshape_torch.observation.packing import PixelSamples
from directshape_torch.shape.shape_prior import BoundShape, ShapePrior

_SAMPLES = 64
_LOOKUPS_PER_POINT = 2


@dataclass(frozen=True)
class NeededLookups:
    """Points of one iteration, the contours' first, each to be looked up twice.

    Attributes:
        points_obj: (P, 3).
        object_index: (P,).
        num_contour: of them belong to silhouettes.
    """

    points_obj: Tensor
    object_index: Tensor
    num_contour: int

    @property
    def num_surface(self) -> int:
        return len(self.points_obj) - self.num_contour

    @property
    def num_lookups(self) -> int:
        return _LOOKUPS_PER_POINT * len(self.points_obj)


@torch.no_grad()
def needed_lookups(
    prior: ShapePrior,
    state: CarState,
    cars: CarBatch,
    left: PixelSamples,
    right: PixelSamples,
    config: RefinerConfig,
) -> NeededLookups:
    """The points at a state, in the last stage: least distances near the contour of both views, and surface points.

    Args:
        prior: the family of shapes.
        state: of B cars.
        cars: their constants.
        left, right: packed pixels.
        config: contour and saturation, which say what is in play.
    """
    shape = prior.bind(state.code)
    zeta = cars.focal_over_depth / config.stages[-1].contour_width_px
    zeta = zeta.clamp(config.silhouette.min_zeta_per_m, config.silhouette.max_zeta_per_m)
    contour, surface = [], []
    for pixels in (left, right):
        marched = _march(shape, prior.bounds_obj, state, pixels)
        in_play = (zeta[pixels.object_index] * marched.least_sdf).abs() < config.silhouette.saturation
        contour.append((marched.closest_obj[in_play], pixels.object_index[in_play]))
        if pixels is left:
            on_car = (marched.least_sdf < 0) & (pixels.foreground > 0.5)
            surface.append((marched.entry_obj[on_car], pixels.object_index[on_car]))
    points, index = (torch.cat(parts) for parts in zip(*contour, *surface, strict=True))
    return NeededLookups(points, index, sum(len(rows) for rows, _ in contour))


@dataclass(frozen=True)
class _Marched:
    least_sdf: Tensor  # (P,) infinite for rays that miss the prior's bounds
    closest_obj: Tensor  # (P, 3)
    entry_obj: Tensor  # (P, 3) first sample inside, where there is one


def _march(shape: BoundShape, bounds_obj: Tensor, state: CarState, pixels: PixelSamples) -> _Marched:
    T = state.T_obj_cam[pixels.object_index]
    origin = (T[:, :3, :3] @ pixels.origin_cam[..., None])[..., 0] + T[:, :3, 3]
    direction = (T[:, :3, :3] @ pixels.ray_cam[..., None])[..., 0]
    interval = ray_box_interval(origin, direction, bounds_obj)
    share = (torch.arange(_SAMPLES, dtype=origin.dtype, device=origin.device) + 0.5) / _SAMPLES
    near, far = (torch.where(interval.hit, end, torch.ones_like(end)) for end in (interval.near, interval.far))
    depth = near[:, None] + (far - near)[:, None] * share
    points = origin[:, None] + depth[..., None] * direction[:, None]
    index = pixels.object_index[:, None].expand_as(depth)
    sdf = shape.value(points.reshape(-1, 3), index.reshape(-1)).view_as(depth)
    least, closest = sdf.min(dim=1)
    entry = (sdf < 0).to(torch.uint8).argmax(dim=1)
    row = torch.arange(len(pixels), device=origin.device)
    return _Marched(torch.where(interval.hit, least, torch.inf), points[row, closest], points[row, entry])
