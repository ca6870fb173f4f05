"""One car's shape as a camera sees it, on a grid of pixels finer than the refinement's own: contour and depth."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.geometry.camera import rays_from_pixels, right_rays
from directshape_torch.observation.occlusion import Side
from directshape_torch.observation.packing import residual_offsets
from directshape_torch.scene import Detections, FrameBatch

Array = NDArray[np.float64]
Window = tuple[int, int, int, int]

_MOST_PIXELS = 10_000
_FINEST_STEP_PX = 0.25
# Between a pixel that shows the car and one whose ray misses all that is known of it lies a contour too.
_FAR_OUTSIDE_M = 1.0


@dataclass(frozen=True)
class PixelGrid:
    """Points at equal steps over a window of an image.

    Attributes:
        first_uv: the upper left one.
        step_px: between neighbours, the same both ways.
        shape: rows and columns.
    """

    first_uv: tuple[float, float]
    step_px: float
    shape: tuple[int, int]

    @classmethod
    def covering(cls, window: Window, most: int = _MOST_PIXELS) -> PixelGrid:
        """A grid over the window (u0, v0, u1, v1), half open, as fine as so many points allow.

        Examples:
            >>> PixelGrid.covering((10, 20, 30, 30), most=50)
            PixelGrid(first_uv=(10.0, 20.0), step_px=2.0, shape=(5, 10))
        """
        u0, v0, u1, v1 = window
        width, height = u1 - u0, v1 - v0
        step = max(math.sqrt(width * height / most), _FINEST_STEP_PX)
        return cls((float(u0), float(v0)), step, (math.ceil(height / step), math.ceil(width / step)))

    def uv(self, like: Tensor) -> Tensor:
        """All points (h w, 2), row by row, with dtype and device of another tensor."""
        rows, columns = (torch.arange(n, dtype=like.dtype, device=like.device) for n in self.shape)
        v, u = torch.meshgrid(rows, columns, indexing="ij")
        first = torch.tensor(self.first_uv, dtype=like.dtype, device=like.device)
        return first + self.step_px * torch.stack([u.flatten(), v.flatten()], dim=1)

    def uv_of(self, row_column: Array) -> Array:
        """Pixels (n, 2) of places (n, 2) between the points, in rows and columns."""
        return np.asarray(self.first_uv) + self.step_px * row_column[:, ::-1]


def rays_of_pixels(
    frames: FrameBatch,
    detections: Detections,
    car: int,
    side: Side,
    uv: Tensor,  # (P, 2)
) -> tuple[Tensor, Tensor]:
    """Origins and directions (P, 3) in the left camera frame of any pixels of a car, as its terms see them.

    In the right image the rig's field is that of the left pixel that corresponds at the car's input depth.
    """
    camera, frame = frames.camera, int(detections.frame_index[car])
    if side == "left":
        ray = rays_from_pixels(uv, camera.K_left[frame])
        return torch.zeros_like(ray), ray
    shift = camera.K_left[frame, 0, 0] * camera.baseline[frame] / detections.T_cam_obj[car, 2, 3]
    shift = shift + camera.K_left[frame, 0, 2] - camera.K_right[frame, 0, 2]
    uv_left = torch.stack([uv[:, 0] + shift, uv[:, 1]], dim=1)
    rays = right_rays(uv, camera.K_right[frame], camera.T_right_cam[frame], *residual_offsets(frames, uv_left))
    return rays.origin_cam, rays.direction_cam


def zero_contours(grid: PixelGrid, closest_sdf: Tensor) -> list[Array]:
    """Lines (n, 2) in pixels along which the projected signed distance (h w,) is zero: the shape's outline."""
    known = closest_sdf.double().clamp_max(_FAR_OUTSIDE_M).view(grid.shape).cpu()
    return [grid.uv_of(line) for line in level_lines(known.numpy(), 0.0)]


def level_lines(values: Array, level: float) -> list[Array]:
    """Lines (n, 2), in rows and columns, along which an image (h, w) has a value, by linear interpolation.

    Examples:
        >>> level_lines(np.array([[0.0, 1.0], [0.0, 1.0]]), 0.25)[0].tolist()
        [[1.0, 0.25], [0.0, 0.25]]
    """
    from skimage.measure import find_contours

    extract: Callable[[Array, float], list[NDArray[Any]]] = find_contours
    return [np.asarray(line, dtype=np.float64) for line in extract(values, level)]
