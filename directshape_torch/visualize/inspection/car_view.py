"""One car of a traced frame with what all of its figures need: images, windows, contours, boxes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.diagnosis.ray_cast import RayCast, cast
from directshape_torch.errors import InputError
from directshape_torch.geometry import se3
from directshape_torch.geometry.box3d import box_corners
from directshape_torch.geometry.camera import rays_from_pixels, right_rays
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.observation.occlusion import Side
from directshape_torch.observation.packing import car_regions, residual_offsets
from directshape_torch.observation.refinable import without_empty_masks
from directshape_torch.scene import Detections, FrameBatch
from directshape_torch.shape.sdf_grid import zero_level_extents
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.terms.cars import CarState
from directshape_torch.visualize.drawing import Picture, picture_of
from directshape_torch.visualize.refinement_trace import RefinementTrace

Array = NDArray[np.float64]

# On every side of a region, a share of it: the input's outline commonly reaches out of it.
_SURROUNDINGS = 0.12


@dataclass(frozen=True)
class CarView:
    """One car of a frame and the trace of its refinement.

    Attributes:
        loaded: the frame.
        trace: of a refinement of its detections.
        car: row of the detections; it took part in the refinement.
        truth_corners_cam: (8, 3) of its labelled box, in the order of `box_corners`, or None.
    """

    loaded: LoadedFrame
    trace: RefinementTrace
    car: int
    truth_corners_cam: Array | None = None

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
        status = self.trace.result.status[self.car]
        return f"frame {self.loaded.frame_id}, car {line}: {status.name}"

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
        return picture_of((frame.images_left if side == "left" else frame.images_right)[0])

    @cached_property
    def regions(self) -> tuple[Window, Window]:
        """Regions of the left and the right image whose pixels speak about the car."""
        detections = without_empty_masks(self.loaded.detections)
        left, right = (r[self.car].tolist() for r in car_regions(self.loaded.frame, detections))
        return (left[0], left[1], left[2], left[3]), (right[0], right[1], right[2], right[3])

    def window(self, side: Side) -> Window:
        """The part of an image to show: the region and a little around it, or the whole image where there is none."""
        u0, v0, u1, v1 = self.regions[0 if side == "left" else 1]
        height, width = self.loaded.frame.sizes[0].tolist()
        if u1 <= u0 or v1 <= v0:
            return 0, 0, width, height
        du, dv = math.ceil(_SURROUNDINGS * (u1 - u0)), math.ceil(_SURROUNDINGS * (v1 - v0))
        return max(u0 - du, 0), max(v0 - dv, 0), min(u1 + du, width), min(v1 + dv, height)

    def panel_aspect(self) -> float:
        """Height over width of a panel that either window fits into, within reason."""
        windows = self.window("left"), self.window("right")
        tallest = max((v1 - v0) / (u1 - u0) for u0, v0, u1, v1 in windows)
        return min(max(tallest, 0.3), 1.0)

    def seen(self, side: Side, number: int) -> tuple[PixelGrid, RayCast]:
        """A state as the camera sees it, within the window, at the points of a grid finer than the refinement's own."""
        grid = PixelGrid.covering(self.window(side))
        uv = grid.uv(self.loaded.frame.images_left)
        rays = rays_of_pixels(self.loaded.frame, self.loaded.detections, self.car, side, uv)
        return grid, cast(self.prior, self.state(number), *rays)

    def contours(self, side: Side, number: int) -> list[Array]:
        """Outline of a state in the image, lines (n, 2) of pixels."""
        known: dict[tuple[Side, int], list[Array]] = self._contours
        if (side, number) not in known:
            grid, seen = self.seen(side, number)
            known[side, number] = zero_contours(grid, seen.closest_sdf)
        return known[side, number]

    @cached_property
    def _contours(self) -> dict[tuple[Side, int], list[Array]]:
        return {}

    @cached_property
    def _footprints(self) -> dict[int, Array]:
        return {}

    @cached_property
    def detector_corners_cam(self) -> Array:
        """(8, 3) of the detection's box."""
        d = self.loaded.detections
        return np.asarray(box_corners(d.T_cam_obj[self.car].double(), d.dimensions_hwl[self.car].double()).cpu())

    def footprint(self, number: int) -> Array:
        """The box of a state's zero level seen from above: x and z (4, 2) in the left camera frame, the front first."""
        known: dict[int, Array] = self._footprints
        if number not in known:
            known[number] = _footprint(self.prior, self.state(number))
        return known[number]

    def centre_cam(self, number: int) -> Array:
        """Middle of the footprint (2,), x and z, metres."""
        return np.asarray(self.footprint(number).mean(axis=0))

    def mask_lines(self, side: Side) -> list[Array]:
        """Outline of the instance mask, lines (n, 2) of pixels; none where there is no mask."""
        d = self.loaded.detections
        mask, present = (d.mask_left, d.has_mask_left) if side == "left" else (d.mask_right, d.has_mask_right)
        if not bool(present[self.car]):
            return []
        padded = np.pad(mask[self.car].double().cpu().numpy(), 1)
        return [line[:, ::-1] - 1 for line in level_lines(padded, 0.5)]


def footprint_of_corners(corners_cam: Array) -> Array:
    """x and z (4, 2) of the lower corners of a box (8, 3), the front first."""
    return np.asarray(corners_cam[:4][:, [0, 2]])


def _footprint(prior: ShapePrior, state: CarState) -> Array:
    extents = zero_level_extents(prior.values(state.code), prior.origin, prior.spacing_m)[0].double()
    (x0, _, z0), (x1, y1, z1) = extents.tolist()
    corners: Sequence[Sequence[float]] = [[x1, y1, z1], [x1, y1, z0], [x0, y1, z0], [x0, y1, z1]]
    corners_obj = torch.tensor(corners, dtype=torch.float64)
    T_cam_obj: Tensor = se3.inverse(state.T_obj_cam)[0].double().cpu()
    return np.asarray((corners_obj @ T_cam_obj[:3, :3].mT + T_cam_obj[:3, 3])[:, [0, 2]])


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
