"""Which points of refined cars the left image shows, by rays against all cars of the frame, and their colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from directshape_torch.evaluation.shape_truth import EstimatedCar

Points = NDArray[np.float64]

# How much deeper than the first surface on its ray a point may lie and still be that surface: mesh and field differ.
_SAME_SURFACE_M = 0.03
# Where the surface turns away from the camera, the smallest error of the fit shows what is beside the car.
_LEAST_RAY_COSINE = 0.2


@dataclass(frozen=True)
class FrameView:
    """The left image of a frame and the refined cars that it shows.

    Attributes:
        image: (H, W, 3) RGB uint8.
        K_left: (3, 3) pixels.
        cars: the refined cars, which hide themselves and one another.
        masks: for each of them the left pixels (H, W) that are known to show it, or None where nothing is known.
    """

    image: NDArray[np.uint8]
    K_left: NDArray[np.float64]
    cars: Sequence[EstimatedCar]
    masks: Sequence[NDArray[np.bool_] | None]

    def is_seen(
        self,
        car: int,
        points_cam: Points,  # (N, 3) on the surface of the car, metres
        normals_cam: Points,  # (N, 3) outward
    ) -> NDArray[np.bool_]:  # (N,)
        """Which points the camera sees: turned towards it, in the image, on the car's mask, and hidden by no car."""
        distance = np.linalg.norm(points_cam, axis=1)
        cosine = -(points_cam * normals_cam).sum(axis=1) / np.maximum(distance, 1e-9)
        seen = (cosine > _LEAST_RAY_COSINE) & (points_cam[:, 2] > 0)
        uv = self.project(points_cam)
        seen &= self._in_image(uv)
        seen[seen] = self._on_mask(car, uv[seen])
        for other in (car, *(row for row in range(len(self.cars)) if row != car)):
            rows = np.flatnonzero(seen)
            depth = self.cars[other].points_at_pixels(uv[rows], torch.from_numpy(self.K_left))[:, 2]
            # A ray that passes a car by has depth NaN, which hides nothing.
            seen[rows[depth < points_cam[rows, 2] - _SAME_SURFACE_M]] = False
        return np.asarray(seen)

    def colours(self, points_cam: Points) -> NDArray[np.uint8]:
        """The image's colours (N, 3) at the points, sRGB, between the four nearest pixels."""
        height, width = self.image.shape[:2]
        uv = self.project(points_cam).clip(0, [width - 1, height - 1])
        u, v = np.minimum(uv, [max(width - 2, 0), max(height - 2, 0)]).astype(np.int64).T
        du, dv = (uv - np.stack([u, v], axis=1)).T[:, :, None]
        right, below = np.minimum(u + 1, width - 1), np.minimum(v + 1, height - 1)
        above = (1 - du) * self.image[v, u] + du * self.image[v, right]
        beneath = (1 - du) * self.image[below, u] + du * self.image[below, right]
        return np.asarray(np.rint((1 - dv) * above + dv * beneath).astype(np.uint8))

    def project(self, points_cam: Points) -> NDArray[np.float64]:
        """Pixels (N, 2) of points; meaningless behind the camera."""
        homogeneous = points_cam @ self.K_left.T
        depth = homogeneous[:, 2:]
        return np.asarray(homogeneous[:, :2] / np.where(depth > 0, depth, 1.0))

    def _in_image(self, uv: NDArray[np.float64]) -> NDArray[np.bool_]:
        height, width = self.image.shape[:2]
        return np.asarray((uv >= 0).all(axis=1) & (uv <= np.array([width - 1, height - 1])).all(axis=1))

    def _on_mask(self, car: int, uv: NDArray[np.float64]) -> NDArray[np.bool_]:
        mask = self.masks[car]
        if mask is None:
            return np.ones(len(uv), dtype=bool)
        column, row = np.rint(uv).astype(np.int64).T
        return np.asarray(mask[row, column])
