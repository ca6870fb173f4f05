"""This module draws lines, text, charts and projected objects on pictures (h, w, 3), RGB uint8, and joins pictures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import numpy.typing as npt

from directshape_torch.errors import InputError
from directshape_torch.files.atomic_files import write_bytes
from directshape_torch.geometry.box3d import BOX_EDGES
from directshape_torch.scene.frames import FrameBatch, Side
from directshape_torch.stereo_matching.disparity import rgb8

if TYPE_CHECKING:
    import trimesh

Picture = npt.NDArray[np.uint8]
Array = npt.NDArray[np.floating[Any]]
Colour = tuple[int, int, int]
Window = tuple[int, int, int, int]
"""This is a part of an image, u_min, v_min, u_max, v_max, where the maxima are excluded."""

# All pictures use these colours: before, after, truth, not refined. Masks are white.
ORANGE, BLUE, GREEN, GREY = (255, 140, 0), (30, 144, 255), (60, 220, 80), (170, 170, 170)
WHITE, BLACK = (255, 255, 255), (0, 0, 0)
GROUND: Colour = (28, 30, 34)
GRID: Colour = (62, 66, 74)

NEAR_PLANE_M = 0.3
# OpenCV takes sub-pixel positions as integers with this many binary digits after the point.
_SHIFT = 4
# Beyond this OpenCV's fixed-point coordinates would overflow.
_FARTHEST_PX = 1e5
_GAP_PX = 6
# The part around a car is larger than the car by this factor, and at least this high for a far car.
_ROOM, _LEAST_TALL_PX = 1.25, 12.0
_LINE_PX = 26


@dataclass(frozen=True)
class View:
    """A `View` is a picture with the projection into its pixels: an image or a part of it, the ground, or a chart."""

    picture: Picture  # (h, w, 3), drawn in place
    P: Array  # (3, 4) from the left camera's frame to homogeneous pixels of the picture
    from_image: Array = field(default_factory=lambda: np.eye(3))  # (3, 3) from the whole image's pixels to these pixels

    @classmethod
    def of_frame(cls, frames: FrameBatch, side: Side = "left", number: int = 0) -> View:
        """An image of one frame of a batch without its padding, by the pinhole model."""
        camera, (height, width) = frames.camera, frames.sizes[number].tolist()
        images, K, T = (
            (frames.images_left, camera.K_left, np.eye(4))
            if side == "left"
            else (frames.images_right, camera.K_right, camera.T_right_cam[number].detach().double().cpu().numpy())
        )
        return cls(rgb8(images[number, :, :height, :width]), K[number].detach().double().cpu().numpy() @ T[:3])

    @property
    def K(self) -> Array:
        """Intrinsics (3, 3) of a left image or of a part of one."""
        return self.P[:, :3]

    def copy(self) -> View:
        """A view with a copy of the picture, so that drawings leave the original unchanged."""
        return replace(self, picture=self.picture.copy())

    def part(self, window: Window, size_wh: tuple[int, int]) -> View:
        """A window, resized; it is black outside the picture."""
        u0, v0, u1, v1 = window
        part = np.zeros((v1 - v0, u1 - u0, 3), np.uint8)
        height, width = self.picture.shape[:2]
        a, b, c, d = max(u0, 0), max(v0, 0), min(u1, width), min(v1, height)
        if c > a and d > b:
            part[b - v0 : d - v0, a - u0 : c - u0] = self.picture[b:d, a:c]
        s_u, s_v = size_wh[0] / (u1 - u0), size_wh[1] / (v1 - v0)
        picture = cv2.resize(part, size_wh, interpolation=cv2.INTER_CUBIC if s_u > 1 else cv2.INTER_AREA)
        # Pixel centres are whole numbers, so the edge of a picture is at -0.5.
        to_part = np.array([[s_u, 0, s_u * (0.5 - u0) - 0.5], [0, s_v, s_v * (0.5 - v0) - 0.5], [0, 0, 1]])
        return View(np.ascontiguousarray(picture, dtype=np.uint8), to_part @ self.P, to_part @ self.from_image)

    def around(self, points_cam: Array, size_wh: tuple[int, int]) -> View | None:
        """The part of the given size that shows points (N, 3) with some room, or None if they are not visible."""
        bounds = self.bounds(points_cam)
        if bounds is None:
            return None
        (u0, v0, u1, v1), aspect = bounds, size_wh[0] / size_wh[1]
        tall = max(_ROOM * (v1 - v0), _ROOM * (u1 - u0) / aspect, _LEAST_TALL_PX)
        height, width = self.picture.shape[:2]
        left, top = (u0 + u1 - aspect * tall) / 2, (v0 + v1 - tall) / 2
        # The part stays within the picture if it fits.
        left, top = min(max(left, 0), max(width - aspect * tall, 0)), min(max(top, 0), max(height - tall, 0))
        window = round(left), round(top), round(left + aspect * tall), round(top + tall)
        return self.part(window, size_wh)

    def project(self, points_cam: Array) -> Array:
        """Pixels (N, 2) of points (N, 3); they mean nothing behind the camera."""
        pixels = points_cam @ self.P[:, :3].T + self.P[:, 3]
        depth = np.where(pixels[:, 2:] > 0, pixels[:, 2:], 1.0)
        return np.asarray(np.clip(pixels[:, :2] / depth, -_FARTHEST_PX, _FARTHEST_PX))

    def places(self, uv: Array) -> Array:
        """Pixels (N, 2) of the picture for pixels of the whole image."""
        return np.asarray(uv @ self.from_image[:2, :2].T + self.from_image[:2, 2])

    def bounds(self, points_cam: Array) -> tuple[float, float, float, float] | None:
        """u_min, v_min, u_max, v_max around the visible part of points, or None if nothing is visible."""
        in_front = points_cam[points_cam[:, 2] > NEAR_PLANE_M]
        if not len(in_front):
            return None
        height, width = self.picture.shape[:2]
        pixels = np.clip(self.project(in_front), 0, [width - 1, height - 1])
        (u0, v0), (u1, v1) = pixels.min(axis=0).tolist(), pixels.max(axis=0).tolist()
        return None if u1 - u0 < 1 or v1 - v0 < 1 else (u0, v0, u1, v1)


def blue_white_red(values: Array, limit: float) -> Array:
    """Colours (*, 3), 0 .. 255: blue from -limit down, white at 0 and for NaN, red from the limit up."""
    share = np.clip(np.nan_to_num(values) / limit, -1, 1)[..., None]
    white, red, blue = (np.array(c, dtype=np.float64) for c in ((245, 245, 245), (214, 47, 39), (49, 87, 200)))
    return np.asarray(white + np.abs(share) * (np.where(share > 0, red, blue) - white))


def draw_contour(view: View, surface: trimesh.Trimesh, colour: Colour, thickness: int = 2) -> None:
    """Draw the outline of the projected shape, as its silhouette term sees it."""
    draw_outline(view.picture, silhouette_mask(view, surface), colour, thickness)


def draw_outline(picture: Picture, mask: Picture, colour: Colour, thickness: int = 2) -> None:
    """Draw the outlines of the nonzero part of a mask (h, w), without the picture's border."""
    rim = 2 + thickness
    contours, _ = cv2.findContours(np.pad(mask, rim, mode="edge"), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(picture, contours, -1, colour, thickness, cv2.LINE_AA, offset=(-rim, -rim))


def silhouette_mask(view: View, surface: trimesh.Trimesh) -> Picture:
    """Mask (h, w), 255 for pixels of the shape's triangles, else 0; triangles partly behind the camera are left out."""
    mask = np.zeros(view.picture.shape[:2], np.uint8)
    vertices, faces = np.asarray(surface.vertices), np.asarray(surface.faces)
    in_front = vertices[:, 2] > NEAR_PLANE_M
    pixels = np.zeros((len(vertices), 2), np.int32)
    pixels[in_front] = _fixed_point(view.project(vertices[in_front]))
    # Triangles are filled one by one, because a joint fill would leave doubly covered pixels empty.
    for triangle in pixels[faces[in_front[faces].all(axis=1)]]:
        cv2.fillConvexPoly(mask, triangle, 255, cv2.LINE_8, _SHIFT)
    return mask


def draw_box(
    view: View,
    corners_cam: Array,  # (8, 3) in the order of `box_corners`
    colour: Colour,
    is_front_known: bool = True,
) -> None:
    """Draw the 12 edges of a 3D box, and its `line_to_front`."""
    for first, second in BOX_EDGES:
        draw_segment(view, corners_cam[first], corners_cam[second], colour)
    draw_segment(view, *line_to_front(corners_cam, is_front_known), colour)


def line_to_front(
    corners_cam: Array,  # (8, 3) in the order of `box_corners`
    is_front_known: bool,
) -> tuple[Array, Array]:  # (3,), (3,)
    """The ends of a line on the ground from the centre to the front, or from end to end where the front is unknown."""
    front, rear = corners_cam[:2].mean(axis=0), corners_cam[2:4].mean(axis=0)
    return 0.5 * (front + rear) if is_front_known else rear, front


def draw_segment(view: View, first_cam: Array, second_cam: Array, colour: Colour) -> None:
    """Draw a straight line in space, cut at the near plane."""
    ends = np.stack([first_cam, second_cam])
    behind = ends[:, 2] < NEAR_PLANE_M
    if behind.all():
        return
    if behind.any():
        share = (NEAR_PLANE_M - ends[0, 2]) / (ends[1, 2] - ends[0, 2])
        ends[int(behind.argmax())] = ends[0] + share * (ends[1] - ends[0])
    draw_line(view, ends, colour)


def draw_line(view: View, points: Array, colour: Colour, thickness: int = 1, *, closed: bool = False) -> None:
    """Draw a line through projected points (N, 3)."""
    pixels = _fixed_point(view.project(points))
    cv2.polylines(view.picture, [pixels], closed, colour, thickness, cv2.LINE_AA, _SHIFT)


def draw_text(
    picture: Picture,
    text: str,
    position: tuple[float, float],
    colour: Colour = WHITE,
    size: float = 0.45,
    widest_px: float = math.inf,
) -> None:
    """Draw text with a dark rim from its lower left corner on, smaller if it is too wide."""
    u, v = round(position[0]), round(position[1])
    # Names of files may contain bytes that are not text, which would crash OpenCV.
    drawable = text.encode("utf-8", "replace").decode()
    size *= min(1.0, widest_px / max(cv2.getTextSize(drawable, cv2.FONT_HERSHEY_SIMPLEX, size, 1)[0][0], 1))
    # The rim is the same text with offsets, because bolder letters of OpenCV 5 are also wider.
    rim = [(du, dv, BLACK) for du in (-1, 0, 1) for dv in (-1, 0, 1) if du or dv]
    for du, dv, ink in (*rim, (0, 0, colour)):
        cv2.putText(picture, drawable, (u + du, v + dv), cv2.FONT_HERSHEY_SIMPLEX, size, ink, 1, cv2.LINE_AA)


def draw_legend(
    picture: Picture, entries: Mapping[str, Colour], position: tuple[int, int], across: bool = False
) -> None:
    """Draw coloured strokes with their meaning, in lines or side by side, from the upper left corner on."""
    (u, v), widths = position, [cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.7, 1)[0][0] + 48 for text in entries]
    wide, lines = (sum(widths), 1) if across else (max(widths), len(entries))
    picture[v : v + _LINE_PX * lines + 4, u : u + wide] //= 3
    for (text, colour), step in zip(entries.items(), widths, strict=True):
        cv2.line(picture, (u + 6, v + 15), (u + 28, v + 15), colour, 3, cv2.LINE_AA)
        draw_text(picture, text, (u + 36, v + 21), WHITE, 0.7)
        u, v = (u + step, v) if across else (u, v + _LINE_PX)


def curves(series: Mapping[str, tuple[Array, Colour]], title: str, size_wh: tuple[int, int], now: int = -1) -> Picture:
    """A chart of values over iterations 0, 1, .., with values from 0 on, coloured names and a mark at `now`."""
    (width, height), left, top, low = size_wh, 70, 44, 56
    most = max(1e-9, *(float(values.max()) for values, _ in series.values()))
    last = max(1, *(len(values) - 1 for values, _ in series.values()))
    per_x, per_y = (width - left - 20) / last, (height - top - low) / most
    to_pixels = [[per_x, 0, 0, left], [0, -per_y, 0, height - low], [0, 0, 0, 1]]
    chart = View(np.full((height, width, 3), GROUND, np.uint8), np.array(to_pixels))
    for share in (0.0, 0.5, 1.0):
        draw_line(chart, np.array([[0, share * most, 0], [last, share * most, 0]]), GRID)
        draw_text(chart.picture, f"{share * most:.3g}", (6, height - low - share * most * per_y + 6), GREY, 0.6)
        number = round(share * last)
        draw_text(chart.picture, f"{number}", (left + per_x * number - 6, height - low + 24), GREY, 0.6)
    if now >= 0:
        draw_line(chart, np.array([[now, 0, 0], [now, most, 0]]), WHITE)
    for row, (name, (values, colour)) in enumerate(series.items()):
        draw_line(chart, np.column_stack([np.arange(len(values)), values, 0 * values]), colour, 2)
        wide = cv2.getTextSize(name, cv2.FONT_HERSHEY_SIMPLEX, 0.65, 1)[0][0]
        draw_text(chart.picture, name, (width - 12 - wide, top + 22 * row + 16), colour, 0.65)
    draw_text(chart.picture, title, (8, 24), size=0.7, widest_px=width - 16)
    draw_text(chart.picture, "iteration", (width / 2, height - 8), GREY, 0.6)
    return chart.picture


def titled(picture: Picture, *lines: str, size: float = 0.7, legend: Mapping[str, Colour] | None = None) -> Picture:
    """The picture below lines of text and, if given, a legend."""
    if legend:
        strip = np.full((_LINE_PX + 4, picture.shape[1], 3), GROUND, np.uint8)
        draw_legend(strip, legend, (0, 0), across=True)
        picture = np.concatenate([strip, picture])
    bar = np.full((_LINE_PX * len(lines) + 4, picture.shape[1], 3), GROUND, np.uint8)
    for row, text in enumerate(lines):
        draw_text(bar, text, (4, _LINE_PX * (row + 1) - 5), size=size, widest_px=bar.shape[1] - 8)
    return np.concatenate([bar, picture])


def beside(pictures: Sequence[Picture], *, below: bool = False) -> Picture:
    """Pictures from left to right, or one below the other, with gaps."""
    height, width = (max(picture.shape[axis] for picture in pictures) for axis in (0, 1))
    parts = []
    for picture in pictures:
        h, w = picture.shape[:2]
        bottom, right = (_GAP_PX, width - w) if below else (height - h, _GAP_PX)
        parts.append(cv2.copyMakeBorder(picture, 0, bottom, 0, right, cv2.BORDER_CONSTANT, value=GROUND))
    return np.asarray(np.concatenate(parts, axis=0 if below else 1), dtype=np.uint8)


def write_gif(path: Path | str, frames: Sequence[Picture], seconds: float, seconds_at_end: float) -> None:
    """Write pictures of one size as a GIF that repeats for ever, the last one shown for longer."""
    if not cv2.haveImageWriter("a.gif"):
        cure = "pip install --upgrade opencv-python-headless"
        raise InputError("OpenCV", "a version that writes GIF files", cv2.__version__, cure)
    animation = cv2.Animation()
    animation.frames = [np.ascontiguousarray(frame[..., ::-1]) for frame in frames]
    animation.durations = [round(1000 * s) for s in (*[seconds] * (len(frames) - 1), seconds_at_end)]
    # Each picture has a palette of 256 colours; dithering would flicker.
    params = [cv2.IMWRITE_GIF_QUALITY, cv2.IMWRITE_GIF_COLORTABLE_SIZE_256, cv2.IMWRITE_GIF_DITHER, 3]
    encoded, content = cv2.imencodeanimation(".gif", animation, params)
    if not encoded:
        raise OSError(f"{path}: cannot encode {len(frames)} pictures as GIF")
    write_bytes(path, content.tobytes())


def _fixed_point(pixels: Array) -> npt.NDArray[np.int32]:
    limited = np.clip(pixels, -_FARTHEST_PX, _FARTHEST_PX)
    fixed: npt.NDArray[np.int32] = np.round(limited * 2**_SHIFT).astype(np.int32)
    return fixed
