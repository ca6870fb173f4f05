"""One state of the cars with everything that several terms need of it, computed once."""

from __future__ import annotations

from functools import cached_property

from torch import Tensor

from directshape_torch.energy.car_state import CarState
from directshape_torch.observation.packing import PixelSamples
from directshape_torch.shape.raycast import ObjectRays, RayMarch, closest_approach_depth, march
from directshape_torch.shape.shape_prior import BoundShape, ShapePrior


class ProjectedView:
    """The rays of one image side against the shapes of a state. Sample depths are constants (detached)."""

    def __init__(self, shape: BoundShape, bounds_obj: Tensor, state: CarState, pixels: PixelSamples, samples: int):
        self._shape, self._bounds, self._samples = shape, bounds_obj, samples
        T = state.T_obj_cam[pixels.object_index]
        R, t = T[:, :3, :3], T[:, :3, 3]
        origin = (R @ pixels.origin_cam[..., None])[..., 0] + t
        direction = (R @ pixels.ray_cam[..., None])[..., 0]
        self.rays = ObjectRays(origin, direction, pixels.object_index)

    @cached_property
    def march(self) -> RayMarch:
        return march(self._shape, self.rays, self._bounds, self._samples)

    @cached_property
    def closest_depth(self) -> Tensor:
        return closest_approach_depth(self.march)


class ProjectedState:
    """State, bound shapes and the two views of it, evaluated on demand and shared by all terms."""

    def __init__(
        self, prior: ShapePrior, state: CarState, left: PixelSamples, right: PixelSamples, samples_per_ray: int
    ):
        self.state = state
        self.shape = prior.bind(state.code)
        bounds = prior.bounds_obj
        self.left = ProjectedView(self.shape, bounds, state, left, samples_per_ray)
        self.right = ProjectedView(self.shape, bounds, state, right, samples_per_ray)
