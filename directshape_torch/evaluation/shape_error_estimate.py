"""Points on the surface of an estimated car: spread evenly over it, or where given pixels see it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.diagnosis.ray_cast import cast
from directshape_torch.evaluation.shape_error import Points
from directshape_torch.geometry import se3
from directshape_torch.geometry.camera import rays_from_pixels
from directshape_torch.shape.sdf_to_mesh import sdf_to_mesh
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.terms.cars import CarState

_SAMPLES_PER_RAY = 96


@dataclass(frozen=True)
class EstimatedCar:
    """One car as a refinement sees it.

    Attributes:
        prior: the family of shapes.
        code: (K,) standard deviations.
        T_cam_obj: (4, 4) object to left camera.
    """

    prior: ShapePrior
    code: Tensor
    T_cam_obj: Tensor

    def sampled_points(self, count: int, seed: int) -> Points:
        """`count` points (count, 3) in camera coordinates, uniform by area over the whole closed surface.

        Raises:
            MeshError: the shape has no surface.
        """
        from trimesh.sample import sample_surface

        values = self.prior.values(self._code())[0]
        mesh = sdf_to_mesh(values, self.prior.origin, self.prior.spacing_m, self.T_cam_obj)
        return np.asarray(sample_surface(mesh, count, seed=seed)[0], dtype=np.float64)

    def depth_at_pixels(
        self,
        uv_left: NDArray[np.float64],  # (P, 2)
        K_left: Tensor,  # (3, 3)
    ) -> NDArray[np.float64]:  # (P,)
        """Depth along the optical axis where the rays of left pixels first meet the surface, NaN where they miss it."""
        like = self.prior.origin
        rays_cam = rays_from_pixels(torch.from_numpy(uv_left), K_left.double()).to(like)
        state = CarState.of(se3.inverse(self.T_cam_obj.double())[None].to(like), self._code())
        return np.asarray(
            cast(self.prior, state, torch.zeros_like(like), rays_cam, _SAMPLES_PER_RAY).depth.double().cpu()
        )

    def points_at_pixels(
        self,
        uv_left: NDArray[np.float64],  # (P, 2)
        K_left: Tensor,  # (3, 3)
    ) -> Points:
        """The points of these depths, (Q, 3) in camera coordinates; rays that miss are left out."""
        depth = self.depth_at_pixels(uv_left, K_left)
        rays_cam = rays_from_pixels(torch.from_numpy(uv_left), K_left.double()).numpy()
        hit = np.isfinite(depth)
        return np.asarray(depth[hit, None] * rays_cam[hit])

    def _code(self) -> Tensor:
        return self.code[None].to(self.prior.origin)
