"""Which points of refined cars the left image shows, by rays against all cars of the frame, and their colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from directshape_torch.evaluation.shape_truth import EstimatedCar
from directshape_torch.visualize.drawing import Array

Points = NDArray[np.float64]

# How much deeper than the first surface on its ray a point may lie and still be that surface: mesh and field differ.
_SAME_SURFACE_M = 0.03
# Where the surface turns away from the camera, the smallest error of the fit shows what is beside the car.
_LEAST_RAY_COSINE = 0.2


@dataclass(frozen=True)
class FrameView:
    """The left image of a frame and the refined cars that it shows."""

    image: NDArray[np.uint8]  # (H, W, 3) RGB
    K_left: Array  # (3, 3) pixels
    cars: Sequence[EstimatedCar]  # which hide themselves and one another
    masks: Sequence[NDArray[np.bool_] | None]  # (H, W) left pixels known to show each car, None where nothing is known

    def is_seen(
        self,
        car: int,
        points_cam: Points,  # (N, 3) on the surface of the car, metres
        normals_cam: Points,  # (N, 3) outward
    ) -> NDArray[np.bool_]:  # (N,)
        """Which points the camera sees: turned towards it, in the image, on the car's mask, and hidden by no car."""
        distance = np.linalg.norm(points_cam, axis=1)
        cosine = -(points_cam * normals_cam).sum(axis=1) / np.maximum(distance, 1e-9)
        height, width = self.image.shape[:2]
        uv, mask = self._project(points_cam), self.masks[car]
        seen = (cosine > _LEAST_RAY_COSINE) & (points_cam[:, 2] > 0)
        seen &= ((uv >= 0) & (uv <= np.array([width - 1, height - 1]))).all(axis=1)
        if mask is not None:
            column, row = np.rint(uv[seen]).astype(np.int64).T
            seen[seen] = mask[row, column]
        for other in (car, *(row for row in range(len(self.cars)) if row != car)):
            rows = np.flatnonzero(seen)
            depth = self.cars[other].points_at_pixels(uv[rows], torch.from_numpy(self.K_left))[:, 2]
            # A ray that passes a car by has depth NaN, which hides nothing.
            seen[rows[depth < points_cam[rows, 2] - _SAME_SURFACE_M]] = False
        return np.asarray(seen)

    def colours(self, points_cam: Points) -> NDArray[np.uint8]:
        """The image's colours (N, 3) at the points, sRGB, between the four nearest pixels."""
        from scipy.ndimage import map_coordinates

        at = self._project(points_cam).T[::-1]
        channels = [map_coordinates(self.image[..., k], at, np.float64, order=1, mode="nearest") for k in range(3)]
        return np.rint(np.stack(channels, axis=1)).astype(np.uint8)

    def _project(self, points_cam: Points) -> NDArray[np.float64]:
        """Pixels (N, 2) of points; meaningless behind the camera."""
        homogeneous = points_cam @ self.K_left.T
        depth = homogeneous[:, 2:]
        return np.asarray(homogeneous[:, :2] / np.where(depth > 0, depth, 1.0))
