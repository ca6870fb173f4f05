"""One state of the cars with everything that several terms need of it, computed once."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import NamedTuple, TypeVar, cast

from torch import Tensor

from directshape_torch.energy.car_state import CarState
from directshape_torch.observation.packing import PixelSamples
from directshape_torch.residuals.photometric import surface_slope
from directshape_torch.shape.raycast import (
    ObjectRays,
    RayMarch,
    Root,
    attached_closest_depth,
    attached_depth,
    closest_approach_depth,
    first_crossing,
    gradient_on_rays,
    march,
    polished_depth,
    sdf_on_rays,
)
from directshape_torch.shape.shape_prior import BoundShape, ShapePrior

# Superlinear from a bracket of one sample distance: 8 reach float32's and nearly float64's precision.
ROOT_ITERATIONS = 8


_T = TypeVar("_T")


class SeenSurface(NamedTuple):
    """The surface under R pixels."""

    depth: Tensor  # (R,) metres
    on_surface: Tensor  # (R,) bool: there is one, and it is not grazing


class ProjectedView:
    """The rays of one image side against the shapes of a state.

    Sample depths, points of closest approach and surface roots are constants (detached), as the first derivatives of
    the residuals have it. With `moving_depths` the latter two follow the state and the shape, so that a linearisation
    can itself be differentiated (values stay the same).
    """

    def __init__(
        self,
        shape: BoundShape,
        bounds_obj: Tensor,
        state: CarState,
        pixels: PixelSamples,
        samples: int,
        *,
        frozen: ProjectedView | None = None,
        root_iterations: int = ROOT_ITERATIONS,
        moving_depths: bool = False,
    ):
        self._shape, self._samples = shape, samples
        self.bounds_obj = bounds_obj
        self._frozen, self._root_iterations, self._moving_depths = frozen, root_iterations, moving_depths
        T = state.T_obj_cam[pixels.object_index]
        R, t = T[:, :3, :3], T[:, :3, 3]
        origin = (R @ pixels.origin_cam[..., None])[..., 0] + t
        direction = (R @ pixels.ray_cam[..., None])[..., 0]
        self.rays = ObjectRays(origin, direction, pixels.object_index)
        self._seen: dict[float, Tensor] = {}  # by the least cosine: which rays (P,) see a surface

    @cached_property
    def march(self) -> RayMarch:
        if self._frozen is not None:
            return self._frozen.march
        return march(self._shape, self.rays, self.bounds_obj, self._samples)

    @cached_property
    def closest_depth(self) -> Tensor:
        if self._frozen is not None:
            return self._frozen.closest_depth
        if self._moving_depths:
            return attached_closest_depth(self._shape, self.rays, self.bounds_obj, self.march)
        return closest_approach_depth(self.march)

    @cached_property
    def closest_sdf(self) -> Tensor:
        """Signed distance (P,) at the closest approach, a constant."""
        at_closest = self.march.closest_sdf
        # Of a frozen march it is that of another state, and depths that move are found anew.
        if at_closest is not None and self._frozen is None and not self._moving_depths:
            return at_closest
        return sdf_on_rays(self._shape, self.rays, self.closest_depth.detach()).detach()

    @cached_property
    def _entry(self) -> Root:
        """Where every ray enters the shape, a constant."""
        closest = self.closest_depth.detach()
        return first_crossing(self._shape, self.rays, self.march, closest, self._root_iterations, self.closest_sdf)

    @cached_property
    def _gradient_at_entry(self) -> Tensor:
        """Gradient (P, 3) of the field where the rays enter, a constant; zero for those that do not."""
        if self._entry.gradient is not None:
            return self._entry.gradient
        entering = self._entry.found.nonzero()[:, 0]
        gradient = gradient_on_rays(self._shape, self.rays.select(entering), self._entry.depth[entering])
        return gradient.new_zeros(len(self._entry.found), 3).index_copy(0, entering, gradient).detach()

    def surface(self, rows: Tensor) -> tuple[ObjectRays, Root]:
        """Where some of the rays (Q,) enter the shape."""
        rays = self.rays.select(rows)
        if self._frozen is not None:
            root = self._frozen.surface(rows)[1]
            return rays, root._replace(depth=polished_depth(self._shape, rays, root, self._root_iterations))
        root = Root(*(x.index_select(0, rows) for x in (self._entry.depth, self._entry.found)))
        if self._moving_depths:
            root = root._replace(depth=attached_depth(self._shape, rays, root.depth, root.found))
        return rays, root

    def surface_gradient(self, rows: Tensor, root: Root) -> Tensor:
        """Gradient (Q, 3) of the field where some of the rays enter, as `surface` says, a constant.

        In a plain projection it is looked up once for all who ask. Where no ray enters it means nothing.
        """
        if self._is_plain:
            return self._gradient_at_entry.index_select(0, rows)
        return gradient_on_rays(self._shape, self.rays.select(rows), root.depth.detach()).detach()

    def seen_surface(self, rows: Tensor, min_cosine: float) -> SeenSurface:
        """The surface under some of the rays (Q,), constants."""
        if self._is_plain:
            if min_cosine not in self._seen:
                self._seen[min_cosine] = self._not_grazing(self.rays, self._entry, self._gradient_at_entry, min_cosine)
            of_all = self._entry.depth.detach(), self._seen[min_cosine]
            return SeenSurface(*(x.index_select(0, rows) for x in of_all))
        rays, root = self.surface(rows)
        gradient = self.surface_gradient(rows, root)
        return SeenSurface(root.depth.detach(), self._not_grazing(rays, root, gradient, min_cosine))

    @property
    def _is_plain(self) -> bool:
        """Whether entries are those of this state, and constants."""
        return self._frozen is None and not self._moving_depths

    @staticmethod
    def _not_grazing(rays: ObjectRays, root: Root, gradient: Tensor, min_cosine: float) -> Tensor:
        """Of rays that enter with these gradients, (Q,) bool."""
        return root.found & ~surface_slope(gradient, rays.direction_obj.detach(), min_cosine)[1]


class ProjectedState:
    """State, bound shapes and the two views of it, evaluated on demand and shared by all terms.

    Args:
        prior: the family of shapes.
        state: B cars.
        left, right: packed pixels.
        samples_per_ray: coarse samples inside the prior's bounds.
        frozen: another projection of the same pixels whose samples, points of closest approach and hits are kept, as
            differences of residuals need it; surface roots are its roots moved by `root_iterations` Newton steps.
        root_iterations: of the surface roots.
        moving_depths: see `ProjectedView`.
    """

    def __init__(
        self,
        prior: ShapePrior,
        state: CarState,
        left: PixelSamples,
        right: PixelSamples,
        samples_per_ray: int,
        *,
        frozen: ProjectedState | None = None,
        root_iterations: int = ROOT_ITERATIONS,
        moving_depths: bool = False,
    ):
        self.state = state
        self.shape = prior.bind(state.code)

        self._pixels, self._frozen = (left, right), frozen
        self._bounds_obj, self._samples = prior.bounds_obj, samples_per_ray
        self._root_iterations, self._moving_depths = root_iterations, moving_depths
        self._known: list[tuple[object, object]] = []

    def once(self, owner: object, find: Callable[[], _T]) -> _T:
        """What `find` gives, a constant, found once for an owner that never changes: for those who ask here again."""
        for then, known in self._known:
            if then is owner:
                return cast(_T, known)
        found = find()
        self._known.append((owner, found))
        return found

    # No closure over `self` anywhere: a cycle would keep every march alive until the garbage collector comes by.
    def _view(self, pixels: PixelSamples, frozen: ProjectedView | None) -> ProjectedView:
        return ProjectedView(
            self.shape,
            self._bounds_obj,
            self.state,
            pixels,
            self._samples,
            frozen=frozen,
            root_iterations=self._root_iterations,
            moving_depths=self._moving_depths,
        )

    @cached_property
    def left(self) -> ProjectedView:
        """The rays of the left image."""
        return self._view(self._pixels[0], None if self._frozen is None else self._frozen.left)

    @cached_property
    def right(self) -> ProjectedView:
        """The rays of the right image."""
        return self._view(self._pixels[1], None if self._frozen is None else self._frozen.right)
