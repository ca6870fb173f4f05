"""One car of a traced frame with what all of its figures need: images, windows, contours, boxes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.geometry import se3
from directshape_torch.geometry.box3d import box_corners
from directshape_torch.geometry.camera import rays_from_pixels, right_rays
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.observation.occlusion import Side
from directshape_torch.observation.packing import car_regions, residual_offsets
from directshape_torch.observation.refinable import without_empty_masks
from directshape_torch.refinement.ray_cast import cast
from directshape_torch.shape.sdf_grid import zero_level_extents
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.stereo_matching.disparity import rgb8
from directshape_torch.terms.cars import CarState
from directshape_torch.visualize.drawing import Picture, Window, pixel_grid
from directshape_torch.visualize.refinement_trace import RefinementTrace

Array = NDArray[np.float64]

# On every side of a region, a share of it: the input's outline commonly reaches out of it.
_SURROUNDINGS = 0.12
# Rays for an outline, and how far apart they are at least.
_MOST_PIXELS, _FINEST_STEP_PX = 10_000, 0.25
# Between a pixel that shows the car and one whose ray misses all that is known of it lies a contour too.
_FAR_OUTSIDE_M = 1.0


@dataclass(frozen=True)
class CarView:
    """One car of a frame and the trace of its refinement."""

    loaded: LoadedFrame
    trace: RefinementTrace  # of a refinement of the frame's detections
    car: int  # row of the detections; it took part in the refinement
    truth_corners_cam: Array | None = None  # (8, 3) of its labelled box, in the order of `box_corners`

    def __post_init__(self) -> None:
        if self.trace.place_of(self.car) < 0:
            status = self.trace.result.status[self.car] if 0 <= self.car < len(self.trace.result) else "no such car"
            raise InputError("car", "a car that was refined", f"{self.car} ({status})")

    @property
    def prior(self) -> ShapePrior:
        return self.trace.result.prior

    @property
    def title(self) -> str:
        """Frame, car and how it ended."""
        line = self.loaded.detected_objects[self.car].line_number
        return f"frame {self.loaded.frame_id}, car {line}: {self.trace.result.status[self.car].name}"

    @cached_property
    def steps(self) -> list[int]:
        """Numbers of the states to show: the input, every one to which the car moved, the last."""
        return self.trace.steps_of(self.car)

    def state(self, number: int) -> CarState:
        """State of this car alone."""
        return CarState(*(x[self.car : self.car + 1] for x in self.trace.states[number]))

    def image(self, side: Side) -> Picture:
        """(H, W, 3) RGB uint8."""
        frame = self.loaded.frame
        return rgb8((frame.images_left if side == "left" else frame.images_right)[0])

    def window(self, side: Side) -> Window:
        """The region whose pixels speak about the car and a little around it; the whole image where there is none."""
        regions = car_regions(self.loaded.frame, without_empty_masks(self.loaded.detections))
        u0, v0, u1, v1 = regions[0 if side == "left" else 1][self.car].tolist()
        height, width = self.loaded.frame.sizes[0].tolist()
        if u1 <= u0 or v1 <= v0:
            return 0, 0, width, height
        du, dv = math.ceil(_SURROUNDINGS * (u1 - u0)), math.ceil(_SURROUNDINGS * (v1 - v0))
        return max(u0 - du, 0), max(v0 - dv, 0), min(u1 + du, width), min(v1 + dv, height)

    def show(self, axes: Any, side: Side, title: str = "", *, dimmed: bool = False) -> None:
        """The window on axes of matplotlib, in pixels; grey and pale where something is to be drawn over it."""
        u0, v0, u1, v1 = self.window(side)
        part = self.image(side)[v0:v1, u0:u1]
        if dimmed:
            part = np.repeat(part.mean(axis=2, keepdims=True) * 0.55 + 20, 3, axis=2).astype(np.uint8)
        axes.imshow(part, extent=(u0 - 0.5, u1 - 0.5, v1 - 0.5, v0 - 0.5), interpolation="nearest")
        axes.set(xlim=(u0 - 0.5, u1 - 0.5), ylim=(v1 - 0.5, v0 - 0.5), xticks=[], yticks=[])
        axes.set_title(title, fontsize=9)

    def panel_aspect(self) -> float:
        """Height over width of a panel that either window fits into, within reason."""
        windows = self.window("left"), self.window("right")
        return min(max(0.3, *((v1 - v0) / (u1 - u0) for u0, v0, u1, v1 in windows)), 1.0)

    def contours(self, side: Side, number: int) -> list[Array]:
        """Outline of a state in the image, lines (n, 2) of pixels: where the least distance along a ray is zero."""
        u0, v0, u1, v1 = window = self.window(side)
        step = max(math.sqrt((u1 - u0) * (v1 - v0) / _MOST_PIXELS), _FINEST_STEP_PX)
        grid = pixel_grid(window, math.ceil((u1 - u0) / step)).to(self.loaded.frame.images_left)
        rays = self._rays(side, grid.reshape(-1, 2))
        closest = cast(self.prior, self.state(number), *rays).closest_sdf.double().clamp_max(_FAR_OUTSIDE_M)
        first, step = grid[0, 0].cpu().numpy(), float(grid[0, 1, 0] - grid[0, 0, 0])
        return [first + step * line for line in _level_lines(closest.view(grid.shape[:2]).cpu().numpy(), 0.0)]

    def _rays(self, side: Side, uv: Tensor) -> tuple[Tensor, Tensor]:
        """Origins and directions (P, 3) in the left camera frame of any pixels of the car, as its terms see them.

        In the right image the rig's field is that of the left pixel that corresponds at the car's input depth.
        """
        frames, detections = self.loaded.frame, self.loaded.detections
        camera, frame = frames.camera, int(detections.frame_index[self.car])
        if side == "left":
            ray = rays_from_pixels(uv, camera.K_left[frame])
            return torch.zeros_like(ray), ray
        shift = camera.K_left[frame, 0, 0] * camera.baseline[frame] / detections.T_cam_obj[self.car, 2, 3]
        shift = shift + camera.K_left[frame, 0, 2] - camera.K_right[frame, 0, 2]
        uv_left = torch.stack([uv[:, 0] + shift, uv[:, 1]], dim=1)
        rays = right_rays(uv, camera.K_right[frame], camera.T_right_cam[frame], *residual_offsets(frames, uv_left))
        return rays.origin_cam, rays.direction_cam

    @cached_property
    def footprints(self) -> Array:
        """The box of each state's zero level seen from above: x and z (N + 1, 4, 2), metres, the front first."""
        state = CarState(*map(torch.cat, zip(*(self.state(k) for k in range(len(self.trace))), strict=True)))
        values = self.prior.values(state.code)
        low, high = zero_level_extents(values, self.prior.origin, self.prior.spacing_m).double().cpu().unbind(1)
        x = torch.stack([high[:, 0], high[:, 0], low[:, 0], low[:, 0]], dim=1)
        z = torch.stack([high[:, 2], low[:, 2], low[:, 2], high[:, 2]], dim=1)
        corners_obj = torch.stack([x, high[:, 1:2].expand_as(x), z], dim=-1)
        T_cam_obj = se3.inverse(state.T_obj_cam).double().cpu()
        corners_cam = corners_obj @ T_cam_obj[:, :3, :3].mT + T_cam_obj[:, None, :3, 3]
        return np.asarray(corners_cam[..., [0, 2]])

    @property
    def detector_corners_cam(self) -> Array:
        """(8, 3) of the detection's box."""
        d = self.loaded.detections
        return np.asarray(box_corners(d.T_cam_obj[self.car].double(), d.dimensions_hwl[self.car].double()).cpu())

    def mask_lines(self, side: Side) -> list[Array]:
        """Outline of the instance mask, lines (n, 2) of pixels; none where there is no mask."""
        d = self.loaded.detections
        mask, present = (d.mask_left, d.has_mask_left) if side == "left" else (d.mask_right, d.has_mask_right)
        if not bool(present[self.car]):
            return []
        return [line - 1 for line in _level_lines(np.pad(mask[self.car].double().cpu().numpy(), 1), 0.5)]


def draw_lines(axes: Any, lines: Iterable[Array], ink: Any, label: str | None = None, **style: Any) -> None:
    """Lines (n, 2) as one entry of the legend."""
    for line in lines:
        axes.plot(line[:, 0], line[:, 1], color=ink, label=label, **style)
        label = None


def footprint_of_corners(corners_cam: Array) -> Array:
    """x and z (4, 2) of the lower corners of a box (8, 3), the front first."""
    return np.asarray(corners_cam[:4][:, [0, 2]])


def _level_lines(values: Array, level: float) -> list[Array]:
    """Lines (n, 2), in columns and rows, along which an image (h, w) has a value, by linear interpolation."""
    from skimage.measure import find_contours

    extract: Callable[[Array, float], list[Array]] = find_contours
    return [np.asarray(line[:, ::-1], dtype=np.float64) for line in extract(values, level)]
