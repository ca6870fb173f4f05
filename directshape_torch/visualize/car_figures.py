"""This module draws figures of a car: sampled pixels, residuals, and its iterations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from directshape_torch.config import SamplingMode
from directshape_torch.errors import InputError
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.observation.packing import pack_pixels, residual_offsets
from directshape_torch.scene.frames import SIDES, Side
from directshape_torch.scene.masks import MASK_THRESHOLD
from directshape_torch.visualize.drawing import (
    BLUE,
    GREEN,
    ORANGE,
    WHITE,
    Array,
    Colour,
    Picture,
    View,
    beside,
    curves,
    draw_contour,
    draw_outline,
    titled,
)
from directshape_torch.visualize.drawn_car import DrawnCar, cars_of_result
from directshape_torch.visualize.overlay import draw_footprint, ground_view
from directshape_torch.visualize.refinement_trace import RefinementTrace
from directshape_torch.visualize.residuals import WORST_GREY_LEVELS, CarResiduals, PixelResiduals, draw_residuals

_PANEL_PX, _LARGE_PX = (400, 300), (720, 540)
# These are the words and the colour for each way to choose sampled pixels.
_CHOSEN: dict[SamplingMode, tuple[str, Colour]] = {
    "adaptive": ("strongest gradient of its cell", (0, 255, 0)),
    "uniform": ("evenly spaced", (255, 255, 0)),
    "dense": ("whole region", (255, 255, 0)),
}
_ROSE: Colour = (230, 80, 160)
_RED: Colour = (235, 90, 80)
_COST_INKS: dict[str, Colour] = {
    "sum": WHITE,
    "photometric": _RED,
    "silhouette_left": (90, 200, 230),
    "silhouette_right": (60, 140, 170),
}
_KINDS = {"silhouette_left": "silhouette left", "silhouette_right": "silhouette right", "photometric": "photometric"}
_MEANING = (
    "silhouette: orange spills out of the mask, violet does not fill it; mean of -log p",
    "photometric: right image darker (blue), equal (white), brighter (red), lost (grey); mean in grey levels, "
    f"full colour from {WORST_GREY_LEVELS:.0f}",
)


@dataclass(frozen=True)
class CarCourse:
    """A `CarCourse` is one car of a frame with the states of its refinement."""

    loaded: LoadedFrame
    trace: RefinementTrace  # of a refinement of the frame's detections
    row: int  # row of the detections; the car took part in the refinement
    truth_corners_cam: Array | None = None  # (8, 3) of the labelled box, in the order of `box_corners`

    def __post_init__(self) -> None:
        if self.trace.place_of(self.row) < 0:
            status = self.trace.result.status[self.row] if 0 <= self.row < len(self.trace.result) else "no such car"
            raise InputError("car", "a car that was refined", f"{self.row} ({status})")

    @property
    def title(self) -> str:
        """Frame, car and status, as text."""
        return f"frame {self.loaded.frame_id}, car {self.cars[0].line}: {self.trace.result.status[self.row].name}"

    @cached_property
    def steps(self) -> list[int]:
        """Numbers of the states to show: the input, every state to which the car moved, and the last one."""
        return self.trace.steps_of(self.row)

    @cached_property
    def cars(self) -> list[DrawnCar]:
        """The car at each of the steps."""
        line = self.loaded.detected_objects[self.row].line_number
        return [cars_of_result(self.trace.moment(number)[self.row], [line])[0] for number in self.steps]

    @property
    def costs(self) -> dict[str, NDArray[np.float64]]:
        """Cost (N + 1,) of each term by its name, with the settings of the final stage, and their "sum"."""
        costs = self.trace.costs[:, self.row].cpu().numpy()
        return {**dict(zip(self.trace.result.term_names, costs.T, strict=True)), "sum": costs.sum(axis=1)}

    def view(self, side: Side, size_wh: tuple[int, int] = _PANEL_PX) -> View:
        """The part of an image around the car; the disparity field is evaluated at the input pose of the car."""
        frame, image = self.loaded.frame, View.of_frame(self.loaded.frame, side)
        if side == "right":
            centre = self.cars[0].corners_cam.mean(axis=0, keepdims=True)
            uv = torch.from_numpy(View.of_frame(frame).project(centre)).to(frame.images_left)
            bias, vertical = (float(offset) for offset in residual_offsets(frame, uv))
            shift = np.array([[1.0, 0.0, -bias], [0.0, 1.0, vertical], [0.0, 0.0, 1.0]])
            image = View(image.picture, shift @ image.P)
        shown = np.concatenate([self.cars[0].corners_cam, self.cars[-1].corners_cam])
        height, width = image.picture.shape[:2]
        return image.around(shown, size_wh) or image.part((0, 0, width, height), size_wh)

    def outlined(self, side: Side, cars: Sequence[tuple[DrawnCar, Colour]] = ()) -> Picture:
        """The car in an image, with its mask in white and its contours in some states."""
        view = self.view(side)
        self.draw_mask(view, side)
        for car, ink in cars:
            if car.surface is not None:
                draw_contour(view, car.surface, ink, 2)
        return view.picture

    def draw_mask(self, view: View, side: Side) -> None:
        """Draw the outline of the instance mask, if there is one."""
        d = self.loaded.detections
        masks, present = (d.mask_left, d.has_mask_left) if side == "left" else (d.mask_right, d.has_mask_right)
        if bool(present[self.row]):
            mask = masks[self.row].float().cpu().numpy()
            size_wh = view.picture.shape[1::-1]
            found = cv2.warpAffine(mask, view.from_image[:2], size_wh, flags=cv2.INTER_LINEAR)
            draw_outline(view.picture, (found > MASK_THRESHOLD).astype(np.uint8), WHITE, 1)

    def from_above(self, count: int) -> Picture:
        """The first `count` boxes and the true one from above, with room for all boxes, as an animation needs."""
        truth = [] if self.truth_corners_cam is None else [self.truth_corners_cam]
        points_cam = np.concatenate([*truth, *(car.corners_cam for car in self.cars)])
        ground = ground_view(points_cam, _PANEL_PX[1:] * 2, margin_m=0.7, least_depth_m=1.0)
        for corners_cam in truth:
            draw_footprint(ground, corners_cam, GREEN, 3)
        for place, (car, ink) in enumerate(zip(self.cars[:count], _step_inks(len(self.cars)), strict=False)):
            draw_footprint(ground, car.corners_cam, ink, 2 if place == count - 1 else 1, "", car.is_front_known)
        return ground.picture


def sampled_pixels_of(car: CarCourse, side: Side) -> tuple[NDArray[np.int64], int]:
    """The pixels (P, 2) that the refinement used, and the number of further pixels that nearer instances hide."""
    trace, config = car.trace, replace(car.trace.config.sampling, occlusion=False)
    unhidden = pack_pixels(car.loaded.frame, car.loaded.detections, config)
    (used, place), (found, row) = (
        (seen.left if side == "left" else seen.right, number)
        for seen, number in ((trace.pixels, trace.place_of(car.row)), (unhidden, car.row))
    )
    uv = used.uv[used.object_index == place]
    return np.asarray(uv.long().cpu()), int((found.object_index == row).sum()) - len(uv)


def sampling_figure(car: CarCourse) -> Picture:
    """The sampled pixels in both images."""
    panels = []
    for side in SIDES:
        uv, num_hidden = sampled_pixels_of(car, side)
        config = car.trace.config.sampling
        words, ink = _CHOSEN[config.mode if side == "left" else config.mode_right]
        view = car.view(side, _LARGE_PX)
        car.draw_mask(view, side)
        for place in view.places(uv.astype(np.float64)).round().astype(int).tolist():
            cv2.circle(view.picture, place, 2, ink, -1, cv2.LINE_AA)
        title = f"{side} image: {len(uv)} pixels, {num_hidden} more hidden by nearer cars"
        panels.append(titled(view.picture, title, legend={words: ink, "mask": WHITE}))
    return titled(beside(panels), car.title)


def residual_figure(car: CarCourse) -> Picture:
    """The residuals of input and result in three columns, with the contour."""
    rows = []
    for name, number, drawn, ink in (("before", 0, 0, ORANGE), ("after", len(car.trace) - 1, -1, BLUE)):
        residuals = car.trace.residuals(number)[car.row]
        panels = []
        for kind, words in _KINDS.items():
            view = car.view("right" if kind == "silhouette_right" else "left")
            draw_residuals(view, residuals, kind, 0.6)
            surface = car.cars[drawn].surface
            if surface is not None:
                draw_contour(view, surface, ink, 1)
            panels.append(titled(view.picture, f"{name}: {words}, {_mean(residuals, kind)}"))
        rows.append(beside(panels))
    return titled(beside(rows, below=True), car.title, *_MEANING)


def _mean(residuals: CarResiduals, kind: str) -> str:
    values: PixelResiduals = getattr(residuals, kind)
    counted = np.abs(values.value[~values.lost])
    return f"mean {counted.mean():.2f}" if len(counted) else "no pixels"


def iteration_frames(car: CarCourse) -> list[Picture]:
    """One picture for each step: contour in both images, box from above, costs."""
    costs = {name: (values, _COST_INKS[name]) for name, values in car.costs.items() if name in _COST_INKS}
    inks, frames = _step_inks(len(car.cars)), []
    for place, (number, drawn) in enumerate(zip(car.steps, car.cars, strict=True)):
        images = [titled(car.outlined(side, [(drawn, inks[place])]), f"{side} image") for side in SIDES]
        above = titled(car.from_above(place + 1), "seen from above")
        chart = curves(costs, "cost", (_PANEL_PX[1], above.shape[0]), number)
        frames.append(titled(beside([*images, above, chart]), f"{car.title}, iteration {number}", legend=_legend(car)))
    return frames


def _legend(car: CarCourse) -> dict[str, Colour]:
    truth: dict[str, Colour] = {} if car.truth_corners_cam is None else {"ground truth": GREEN}
    return {"input": ORANGE, "last iteration": BLUE, "mask": WHITE, **truth}


def _step_inks(count: int) -> list[Colour]:
    """Colours of the steps, from the input's by way of rose to the result's."""
    ends, at = np.array([ORANGE, _ROSE, BLUE]), np.linspace(0, 2, max(count, 2))
    return [(int(r), int(g), int(b)) for r, g, b in zip(*(np.interp(at, (0, 1, 2), c) for c in ends.T), strict=True)]
