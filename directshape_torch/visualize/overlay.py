"""This module draws a frame before and after its refinement: image, enlarged cars, and the view from above."""

from __future__ import annotations

import math
from collections.abc import Sequence
from numbers import Integral

import numpy as np
import torch

from directshape_torch.errors import InputError, shown
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.numerics.checks import check_type
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import FrameBatch
from directshape_torch.visualize.drawing import (
    BLUE,
    GREEN,
    GREY,
    GRID,
    GROUND,
    ORANGE,
    Array,
    Colour,
    Picture,
    View,
    beside,
    draw_box,
    draw_contour,
    draw_legend,
    draw_line,
    draw_text,
    line_to_front,
    titled,
)
from directshape_torch.visualize.drawn_car import DrawnCar, drawn_cars, most_telling, true_corners

_LEAST_WIDTH_PX = 1000
_BIRDS_EYE_WIDTH_PX = 560
# A thick contour would hide a car that is smaller than this.
_TALL_PX = 60
_TILES_A_ROW = (4, 7)
_CAMERA = np.array([[0.0, 0.0, 0.0], [-0.6, 0.0, 1.2], [0.6, 0.0, 1.2]])


def overlay(frames: FrameBatch, detections: Detections, result: RefinementResult, frame: int = 0) -> Picture:
    """The picture of one frame of a call before and after its refinement, from the tensors of the call.

    It shows the same as `refine --overlays`: contours and boxes in the left image, each car enlarged, and all cars from
    above. Cars have the numbers of their rows in the call, as in `print(result)`. Cars that were not refined are grey,
    and a car whose detected box is not finite is left out. At most 60 cars are shown, the refined ones first, then the
    nearest.

    Args:
        frames: frames of the call, F frames.
        detections: detections of the call, N cars.
        result: result of the call, N cars.
        frame: index of the frame.

    Returns:
        (h, w, 3) RGB, uint8, at least 1000 pixels wide for the image and 560 for the view from above.

    Raises:
        InputError: wrong types, another number of cars in `result` than in `detections`, or no such frame.

    Examples:
        >>> import torch
        >>> import directshape_torch as ds
        >>> K = torch.tensor([[700.0, 0.0, 200.0], [0.0, 700.0, 60.0], [0.0, 0.0, 1.0]])
        >>> image, mask = torch.zeros(3, 120, 400), torch.zeros(1, 120, 400, dtype=torch.bool)
        >>> frames = FrameBatch.from_images(image, image, ds.StereoCamera.from_intrinsics(K, 0.54))
        >>> boxes = torch.tensor([[0.0, 1.6, 15.0, 1.5, 1.7, 4.0, -1.57]])
        >>> detections = Detections.from_boxes(boxes, "kitti", mask_left=mask)
        >>> picture = overlay(frames, detections, ds.DirectShapeRefiner()(frames, detections))
        >>> picture.shape[2], picture.dtype
        (3, dtype('uint8'))
    """
    check_type("frames", frames, (FrameBatch,))
    check_type("detections", detections, (Detections,))
    check_type("result", result, (RefinementResult,))
    if len(result) != len(detections):
        raise InputError("result", f"that of the {len(detections)} detections", f"{len(result)} cars")
    if not (isinstance(frame, Integral) and 0 <= frame < len(frames)):
        raise InputError("frame", f"a number of 0..{len(frames) - 1}", shown(frame))
    rows = most_telling(detections, result, (detections.frame_index == frame).nonzero().flatten().cpu())
    before, after = drawn_cars(detections.rows(rows), result.rows(rows), rows.tolist())
    view = View.of_frame(frames, number=int(frame))
    return overlay_picture(view, before, after, title=f"frame {frames.frame_ids[frame]}")


def overlay_of_frame(loaded: LoadedFrame, result: RefinementResult) -> Picture:
    """The picture (h, w, 3), RGB, of a refined frame."""
    rows = most_telling(loaded.detections, result, torch.arange(len(result)))
    detected = loaded.detected_objects
    lines = [detected[row].line_number for row in rows.tolist()]
    before, after = drawn_cars(loaded.detections.rows(rows), result.rows(rows), lines)
    truth = true_corners(loaded.labels, [one.type for one in detected], loaded.frame.camera.t_cam_ref[0])
    return overlay_picture(View.of_frame(loaded.frame), before, after, truth, f"frame {loaded.frame_id}")


def overlay_picture(
    view: View,
    before: Sequence[DrawnCar],
    after: Sequence[DrawnCar],
    truth_corners_cam: Sequence[Array] = (),
    title: str = "",
) -> Picture:
    """Two rows with the image, before and after; below them each car enlarged; at the right the view from above."""
    rows = [
        _image_row(view, before, f"{title}  before: the start box, mean shape"),
        _image_row(view, after, f"{title}  after: refined box and shape"),
    ]
    left = beside([*rows, *_tile_rows(view, before, after, rows[0].shape[1])], below=True)
    boxes = [car.corners_cam for car in (*before, *after)]
    ground = ground_view(np.concatenate([np.zeros((1, 3)), *boxes]), (left.shape[0], _BIRDS_EYE_WIDTH_PX))
    for corners_cam in truth_corners_cam:
        draw_footprint(ground, corners_cam, GREEN, 2)
    for car in before:
        draw_footprint(ground, car.corners_cam, car.colour, is_front_known=car.is_front_known)
    for car in after:
        draw_footprint(ground, car.corners_cam, car.colour, 2, f"{car.line}", car.is_front_known)
    draw_line(ground, _CAMERA, GREY, closed=True)
    legend = {"before": ORANGE, "after": BLUE}
    legend |= {"ground truth": GREEN} if truth_corners_cam else {}
    legend |= {"not refined": GREY} if any(car.colour == GREY for car in after) else {}
    draw_text(ground.picture, "seen from above", (12, 32), size=0.9)
    draw_legend(ground.picture, legend, (8, 44))
    return np.concatenate([left, ground.picture], axis=1)


def _image_row(image: View, cars: Sequence[DrawnCar], title: str) -> Picture:
    height, width = image.picture.shape[:2]
    scale = max(1.0, _LEAST_WIDTH_PX / width)
    view = image.part((0, 0, width, height), (round(scale * width), round(scale * height)))
    # Far cars come first, so that near cars are drawn over them.
    for car in sorted(cars, key=lambda one: -one.distance_m):
        draw_box(view, car.corners_cam, car.colour, car.is_front_known)
        height_px = float(view.K[1, 1]) * float(np.ptp(car.corners_cam[:, 1])) / max(car.distance_m, 1.0)
        if car.surface is not None:
            draw_contour(view, car.surface, car.colour, 2 if height_px > _TALL_PX else 1)
        roof = car.corners_cam[4:].mean(axis=0, keepdims=True)
        if roof[0, 2] > 1:
            u, v = view.project(roof)[0]
            draw_text(view.picture, f"{car.line}", (u - 8, max(v - 8, 22)), car.colour, 0.9)
    draw_text(view.picture, title, (8, 32), size=1.0, widest_px=view.picture.shape[1] - 16)
    return view.picture


def _tile_rows(image: View, before: Sequence[DrawnCar], after: Sequence[DrawnCar], width_px: int) -> list[Picture]:
    """All visible cars, before above after, in rows of the given width."""
    columns = min(max(len(after), _TILES_A_ROW[0]), _TILES_A_ROW[1])
    wide = width_px // columns - 6
    found = (_tile(image, *pair, (wide, wide * 2 // 3)) for pair in zip(before, after, strict=True))
    tiles = [tile for tile in found if tile is not None]
    return [beside(tiles[first : first + columns]) for first in range(0, len(tiles), columns)]


def _tile(image: View, before: DrawnCar, after: DrawnCar, size_wh: tuple[int, int]) -> Picture | None:
    """A car enlarged, before above after, or None if the image does not show it."""
    states = [car for car in (before, after) if car.surface is not None]
    views = [image.around(np.concatenate([car.corners_cam for car in states]), size_wh) for _ in states]
    pictures = []
    for car, view in zip(states, views, strict=True):
        if view is None or car.surface is None:
            return None
        draw_contour(view, car.surface, car.colour, 2)
        pictures.append(view.picture)
    ending = "" if after.is_refined else f", {after.status}"
    ending += "" if after.is_front_known else ", front unknown"
    return titled(np.concatenate(pictures), f"{after.line}: {after.distance_m:.1f} m{ending}", size=0.8)


def ground_view(
    points_cam: Array,  # (N, 3) to be shown
    size_hw: tuple[int, int],
    margin_m: float = 3.0,
    least_depth_m: float = 15.0,
) -> View:
    """An empty view of the ground from above on a grid of metres, x to the right and z upwards, as large as fits.

    The points are in its middle; later drawings may be outside.
    """
    xz = points_cam[:, [0, 2]]
    low, high = xz.min(axis=0) - margin_m, xz.max(axis=0) + margin_m
    (height, width), (x, z) = size_hw, (low + high) / 2
    px_per_m = float(min(height / max(high[1] - low[1], least_depth_m), width / (high[0] - low[0])))
    left, bottom = x - width / px_per_m / 2, z - height / px_per_m / 2
    to_pixels = [
        [px_per_m, 0.0, 0.0, -px_per_m * left],
        [0.0, 0.0, -px_per_m, height - 1 + px_per_m * bottom],
        [0.0, 0.0, 0.0, 1.0],
    ]
    ground = View(np.full((*size_hw, 3), GROUND, np.uint8), np.array(to_pixels))
    step = next(step for step in (1, 2, 5, 10, 20, 50, 1000) if px_per_m * step > 70)
    right, top = left + width / px_per_m, bottom + height / px_per_m
    for x in _multiples(step, left, right):
        draw_line(ground, np.array([[x, 0, bottom], [x, 0, top]]), GRID)
    for z in _multiples(step, bottom, top):
        draw_line(ground, np.array([[left, 0, z], [right, 0, z]]), GRID)
        # The text is on the right, because a legend is on the left.
        v = ground.project(np.array([[0.0, 0.0, z]]))[0, 1]
        draw_text(ground.picture, f"{z} m", (width - 62, v - 4), GREY, 0.6)
    return ground


def _multiples(step: int, low: float, high: float) -> range:
    return range(math.ceil(low / step) * step, math.floor(high / step) * step + 1, step)


def draw_footprint(
    ground: View,
    corners_cam: Array,  # (8, 3) of a box in the order of `box_corners`, with the first two at the front
    colour: Colour,
    thickness: int = 1,
    label: str = "",
    is_front_known: bool = True,
) -> None:
    """Draw a box from above, with its `line_to_front`, which shows the heading."""
    corners = corners_cam[:4]
    draw_line(ground, corners, colour, thickness, closed=True)
    draw_line(ground, np.stack(line_to_front(corners_cam, is_front_known)), colour, thickness)
    if label:
        pixels = ground.project(corners)
        draw_text(ground.picture, label, (pixels[:, 0].max() + 4, pixels[:, 1].mean() + 8), colour, 0.9)
