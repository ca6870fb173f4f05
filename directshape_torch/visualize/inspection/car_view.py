"""One car of a traced frame with what all of its figures need: images, windows, contours, boxes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.diagnosis.ray_cast import RayCast, cast
from directshape_torch.errors import InputError
from directshape_torch.geometry import se3
from directshape_torch.geometry.box3d import box_corners
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.observation.occlusion import Side
from directshape_torch.observation.packing import car_regions
from directshape_torch.observation.refinable import without_empty_masks
from directshape_torch.refinement_trace import RefinementTrace
from directshape_torch.shape.sdf_grid import zero_level_extents
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.terms.cars import CarState
from directshape_torch.visualize.drawing import Picture, picture_of
from directshape_torch.visualize.inspection.shape_in_image import (
    PixelGrid,
    Window,
    level_lines,
    rays_of_pixels,
    zero_contours,
)

Array = NDArray[np.float64]

# On every side of a region, a share of it: the input's outline commonly reaches out of it.
_SURROUNDINGS = 0.12


@dataclass(frozen=True)
class KnownPoints:
    """Points of a scene whose place is known, in the left camera frame.

    Attributes:
        name: where they come from, for titles.
        points_cam: (P, 3) metres; all are seen in the left image.
        uv: (P, 2) pixels there.
        of_car: (P,) bool, those of the car in question.
    """

    name: str
    points_cam: Array
    uv: Array
    of_car: NDArray[np.bool_]


@dataclass(frozen=True)
class CarView:
    """One car of a frame and the trace of its refinement.

    Attributes:
        loaded: the frame.
        trace: of a refinement of its detections.
        car: row of the detections; it took part in the refinement.
        truth_corners_cam: (8, 3) of its labelled box, in the order of `box_corners`, or None.
        known_points: a scan or the like, or None.
        stereo_points_cam: (P, 3) of the car by dense stereo, or None.
    """

    loaded: LoadedFrame
    trace: RefinementTrace
    car: int
    truth_corners_cam: Array | None = None
    known_points: KnownPoints | None = None
    stereo_points_cam: Array | None = None

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

    def height_above_ground(self, points_cam: Array) -> Array:
        """Height (P,) of points (P, 3) above the frame's ground plane, metres."""
        ground = self.loaded.frame.ground
        normal, offset = ground.normal[0].double().cpu().numpy(), float(ground.offset[0])
        return np.asarray(points_cam @ normal + offset)

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
