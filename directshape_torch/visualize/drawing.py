"""Lines, text and projected things on pictures: (h, w, 3) RGB uint8, drawn in place."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from directshape_torch.geometry.box3d import BOX_EDGES
from directshape_torch.scene import FrameBatch
from directshape_torch.stereo_matching.disparity import rgb8

Picture = npt.NDArray[np.uint8]
Array = npt.NDArray[np.floating[Any]]
Colour = tuple[int, int, int]
Window = tuple[int, int, int, int]
"""A part of an image, half open: u_min, v_min, u_max, v_max."""

ORANGE, BLUE, GREEN, GREY = (255, 140, 0), (30, 144, 255), (60, 220, 80), (170, 170, 170)
WHITE, BLACK = (255, 255, 255), (0, 0, 0)

NEAR_PLANE_M = 0.3
# OpenCV takes sub-pixel positions as integers with this many binary digits after the point.
_SHIFT = 4
# Beyond this OpenCV's fixed-point coordinates would overflow.
_FARTHEST_PX = 1e5


@dataclass(frozen=True)
class View:
    """A picture with the intrinsics that its pixels have: an image, or an enlarged part of one."""

    picture: Picture  # (h, w, 3), drawn in place
    K: Array  # (3, 3), pixels of the picture

    @classmethod
    def of_frame(cls, frame: FrameBatch) -> View:
        """The left image of a frame."""
        return cls(rgb8(frame.images_left[0]), frame.camera.K_left[0].double().cpu().numpy())

    def part(self, window: Window, scale: float) -> View:
        """A window, enlarged; beyond the picture it is black."""
        u0, v0, u1, v1 = window
        part = np.zeros((v1 - v0, u1 - u0, 3), np.uint8)
        height, width = self.picture.shape[:2]
        a, b, c, d = max(u0, 0), max(v0, 0), min(u1, width), min(v1, height)
        if c > a and d > b:
            part[b - v0 : d - v0, a - u0 : c - u0] = self.picture[b:d, a:c]
        size = (max(1, round(scale * (u1 - u0))), max(1, round(scale * (v1 - v0))))
        picture = cv2.resize(part, size, interpolation=cv2.INTER_CUBIC if scale > 1 else cv2.INTER_AREA)
        s_u, s_v = size[0] / (u1 - u0), size[1] / (v1 - v0)
        # Pixel centres are whole numbers: the edge of a picture lies at -0.5.
        to_view = np.array([[s_u, 0, s_u * (0.5 - u0) - 0.5], [0, s_v, s_v * (0.5 - v0) - 0.5], [0, 0, 1]])
        return View(np.ascontiguousarray(picture, dtype=np.uint8), to_view @ self.K)

    def project(self, points_cam: Array) -> Array:
        """Pixels (N, 2) of points (N, 3); meaningless behind the camera."""
        pixels = points_cam @ self.K.T
        depth = np.where(pixels[:, 2:] > 0, pixels[:, 2:], 1.0)
        return np.asarray(np.clip(pixels[:, :2] / depth, -_FARTHEST_PX, _FARTHEST_PX))

    def bounds(self, points_cam: Array) -> tuple[float, float, float, float] | None:
        """u_min, v_min, u_max, v_max around points as far as they are seen, or None where they are not."""
        in_front = points_cam[points_cam[:, 2] > NEAR_PLANE_M]
        if not len(in_front):
            return None
        height, width = self.picture.shape[:2]
        pixels = np.clip(self.project(in_front), 0, [width - 1, height - 1])
        (u0, v0), (u1, v1) = pixels.min(axis=0).tolist(), pixels.max(axis=0).tolist()
        return None if u1 - u0 < 1 or v1 - v0 < 1 else (u0, v0, u1, v1)


@dataclass(frozen=True)
class Surface:
    """Triangles of a shape."""

    vertices: Array  # (V, 3) metres
    faces: npt.NDArray[np.integer[Any]]  # (F, 3)

    def moved(self, T: Array) -> Surface:
        """The same surface where T (4, 4) puts it."""
        return Surface(self.vertices @ T[:3, :3].T + T[:3, 3], self.faces)


def window_around(bounds: tuple[float, float, float, float], wide: float, tall: float) -> Window:
    """A part of an image of some size with bounds in its middle."""
    u, v = (bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2
    return round(u - wide / 2), round(v - tall / 2), round(u + wide / 2), round(v + tall / 2)


def pixel_grid(window: Window, columns: int) -> Tensor:
    """Pixels (h, w, 2) at equal steps over a window, so many in a row."""
    u0, v0, u1, v1 = window
    step = (u1 - u0) / columns
    # Counted in whole numbers: a range of float steps may end on the window's border, outside of the image.
    u, v = u0 + torch.arange(columns) * step, v0 + torch.arange(math.ceil((v1 - v0) * columns / (u1 - u0))) * step
    return torch.stack(torch.meshgrid(u, v, indexing="xy"), dim=-1)


def blue_white_red(values: Array, limit: float) -> Array:
    """Colours (*, 3), 0 .. 255: blue from -limit on, white at 0 and for NaN, red from the limit on."""
    share = np.clip(np.nan_to_num(values) / limit, -1, 1)[..., None]
    white, red, blue = (np.array(c, dtype=np.float64) for c in ((245, 245, 245), (214, 47, 39), (49, 87, 200)))
    return np.asarray(white + np.abs(share) * (np.where(share > 0, red, blue) - white))


def draw_contour(view: View, surface: Surface, colour: Colour, thickness: int = 2) -> None:
    """The outline of the projected shape (what its silhouette term sees); the picture's border is no part of it."""
    padding = 2 + thickness
    mask = silhouette_mask(view, surface, padding)
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(view.picture, contours, -1, colour, thickness, cv2.LINE_AA, offset=(-padding, -padding))


def silhouette_mask(view: View, surface: Surface, padding: int = 0) -> Picture:
    """Where a triangle of the shape is seen, 255, else 0, (h + 2 padding, w + 2 padding): the picture and a rim.

    Triangles that reach behind the camera are left out.
    """
    height, width = view.picture.shape[:2]
    mask = np.zeros((height + 2 * padding, width + 2 * padding), np.uint8)
    in_front = surface.vertices[:, 2] > NEAR_PLANE_M
    pixels = np.zeros((len(surface.vertices), 2), np.int32)
    pixels[in_front] = _fixed_point(view.project(surface.vertices[in_front]) + padding)
    # One by one: a common fill would leave what two triangles cover empty.
    for triangle in pixels[surface.faces[in_front[surface.faces].all(axis=1)]]:
        cv2.fillConvexPoly(mask, triangle, 255, cv2.LINE_8, _SHIFT)
    return mask


def draw_box(
    view: View,
    corners_cam: Array,  # (8, 3) in the order of `box_corners`
    colour: Colour,
) -> None:
    """The 12 edges of a 3D box, and a line on the ground from its centre to its front."""
    for first, second in BOX_EDGES:
        draw_segment(view, corners_cam[first], corners_cam[second], colour)
    draw_segment(view, corners_cam[:4].mean(axis=0), corners_cam[:2].mean(axis=0), colour)


def draw_segment(view: View, first_cam: Array, second_cam: Array, colour: Colour) -> None:
    """A straight line in space, cut at the near plane."""
    ends = np.stack([first_cam, second_cam])
    behind = ends[:, 2] < NEAR_PLANE_M
    if behind.all():
        return
    if behind.any():
        share = (NEAR_PLANE_M - ends[0, 2]) / (ends[1, 2] - ends[0, 2])
        ends[int(behind.argmax())] = ends[0] + share * (ends[1] - ends[0])
    first, second = _fixed_point(view.project(ends))
    cv2.line(view.picture, first.tolist(), second.tolist(), colour, 1, cv2.LINE_AA, _SHIFT)


def draw_polygon(picture: Picture, points_px: Array, colour: Colour, thickness: int = 1) -> None:
    """A closed line through points (N, 2) in pixels."""
    cv2.polylines(picture, [_fixed_point(points_px)], True, colour, thickness, cv2.LINE_AA, _SHIFT)


def draw_text(
    picture: Picture,
    text: str,
    position: tuple[float, float],
    colour: Colour = WHITE,
    size: float = 0.45,
    widest_px: float = math.inf,
) -> None:
    """Text with a dark rim, legible on any ground, from its lower left corner on; smaller where it is too wide."""
    u, v = round(position[0]), round(position[1])
    # Names of files may hold what is no text, which would end the process.
    drawable = text.encode("utf-8", "replace").decode()
    size *= min(1.0, widest_px / max(cv2.getTextSize(drawable, cv2.FONT_HERSHEY_SIMPLEX, size, 1)[0][0], 1))
    # The rim is the same text moved about: in OpenCV 5 bolder letters are also wider.
    rim = [(du, dv, BLACK) for du in (-1, 0, 1) for dv in (-1, 0, 1) if du or dv]
    for du, dv, ink in (*rim, (0, 0, colour)):
        cv2.putText(picture, drawable, (u + du, v + dv), cv2.FONT_HERSHEY_SIMPLEX, size, ink, 1, cv2.LINE_AA)


def draw_legend(picture: Picture, entries: Sequence[tuple[str, Colour]], position: tuple[int, int]) -> None:
    """Coloured strokes with their meaning, one a line, from the upper left corner on."""
    u, v = position
    picture[v - 6 : v + 36 * len(entries) + 6, u - 6 : u + 273] //= 3
    for row, (text, colour) in enumerate(entries):
        middle = v + 36 * row + 18
        for ink, thickness in ((BLACK, 5), (colour, 3)):
            cv2.line(picture, (u, middle), (u + 22, middle), ink, thickness, cv2.LINE_AA)
        draw_text(picture, text, (u + 30, middle + 10), WHITE, 0.9)


def _fixed_point(pixels: Array) -> npt.NDArray[np.int32]:
    limited = np.clip(pixels, -_FARTHEST_PX, _FARTHEST_PX)
    fixed: npt.NDArray[np.int32] = np.round(limited * 2**_SHIFT).astype(np.int32)
    return fixed
