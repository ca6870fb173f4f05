"""A frame before and after its refinement: contours and boxes in the image, enlarged cars, and the view from above."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from directshape_torch.geometry.box3d import box_corners, pose_from_kitti
from directshape_torch.io.kitti_labels import box_corners_cam
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.result import RefinementResult
from directshape_torch.shape.sdf_to_mesh import sdf_to_mesh
from directshape_torch.visualize.birds_eye import Footprint, birds_eye_picture
from directshape_torch.visualize.drawing import (
    BLUE,
    GREEN,
    GREY,
    NEAR_PLANE_M,
    ORANGE,
    Array,
    Colour,
    Picture,
    Surface,
    View,
    draw_box,
    draw_contour,
    draw_legend,
    draw_text,
    picture_of,
    text_size_for,
)

_LEAST_WIDTH_PX = 1000
_BIRDS_EYE_WIDTH_PX = 560
# A thick contour would hide smaller cars.
_TALL_PX = 60


@dataclass(frozen=True)
class DrawnCar:
    """A car in one state, in the left camera frame.

    Attributes:
        corners_cam: (8, 3) of its box, in the order of `box_corners`, metres.
        surface: its shape.
        label: the number of its line.
        note: what is said about it, below its distance.
        is_refined: whether the state comes from a refinement.
    """

    corners_cam: Array
    surface: Surface
    label: str
    note: str = ""
    is_refined: bool = True

    @property
    def distance_m(self) -> float:
        """Depth of its middle."""
        return float(self.corners_cam[:, 2].mean())


def overlay_of_frame(loaded: LoadedFrame, result: RefinementResult) -> Picture:
    """The picture of a refined frame.

    Args:
        loaded: the frame.
        result: of its detections.

    Returns:
        (h, w, 3) RGB uint8.
    """
    frame = loaded.frame
    return overlay_picture(
        picture_of(frame.images_left[0]),
        frame.camera.K_left[0].double().cpu().numpy(),
        before=_initial_cars(loaded, result),
        after=refined_cars(loaded, result),
        truth_corners_cam=_true_corners(loaded),
        title=f"frame {loaded.frame_id}",
    )


def overlay_picture(
    image: Picture,
    K: Array,
    before: Sequence[DrawnCar],
    after: Sequence[DrawnCar],
    truth_corners_cam: Sequence[Array] = (),
    title: str = "",
) -> Picture:
    """Two rows with the image, before and after; below them each car enlarged; beside them the view from above.

    Args:
        image: (H, W, 3) left image.
        K: (3, 3) its intrinsics.
        before, after: the same cars in both states.
        truth_corners_cam: (8, 3) corners of each true box.
        title: of the picture.

    Returns:
        (h, w, 3) RGB uint8.
    """
    rows = [
        _image_row(image, K, before, ORANGE, f"{title}  before: the detection's box, mean shape"),
        _image_row(image, K, after, BLUE, f"{title}  after: refined box and shape"),
    ]
    tiles = [
        CarTile(b.surface, a.surface, BLUE if a.is_refined else GREY, (f"{a.label}: {a.distance_m:.1f} m", a.note))
        for b, a in zip(before, after, strict=True)
    ]
    left = np.concatenate([*rows, tile_strip(image, K, tiles, rows[0].shape[1])])
    footprints = _footprints(before, after, truth_corners_cam)
    right = birds_eye_picture(footprints, (left.shape[0], _BIRDS_EYE_WIDTH_PX))
    legend: list[tuple[str, Colour]] = [("before", ORANGE), ("after", BLUE)]
    legend += [("ground truth", GREEN)] if truth_corners_cam else []
    legend += [("not refined", GREY)] if any(not car.is_refined for car in after) else []
    draw_legend(right, legend, (12, 10), 0.9)
    return np.concatenate([left, right], axis=1)


def _image_row(image: Picture, K: Array, cars: Sequence[DrawnCar], colour: Colour, title: str) -> Picture:
    height, width = image.shape[:2]
    view = View.of_window(image, K, (0, 0, width, height), max(1.0, _LEAST_WIDTH_PX / width))
    # Far cars first, so that near ones are drawn over them.
    for car in sorted(cars, key=lambda car: -car.distance_m):
        ink = colour if car.is_refined else GREY
        draw_box(view, car.corners_cam, ink)
        draw_contour(view, car.surface, ink, 2 if _height_px(view, car) > _TALL_PX else 1)
        _draw_label(view, car, ink)
    draw_text(view.picture, title, (8, 32), size=text_size_for(title, view.picture.shape[1] - 16, 1.0))
    return view.picture


def _height_px(view: View, car: DrawnCar) -> float:
    return float(view.K[1, 1]) * float(np.ptp(car.corners_cam[:, 1])) / max(car.distance_m, 1.0)


def _draw_label(view: View, car: DrawnCar, colour: Colour) -> None:
    roof = car.corners_cam[4:].mean(axis=0, keepdims=True)
    if roof[0, 2] > 1:
        u, v = view.project(roof)[0]
        draw_text(view.picture, car.label, (u - 8, max(v - 8, 22)), colour, 0.9)


def _footprints(
    before: Sequence[DrawnCar], after: Sequence[DrawnCar], truth_corners_cam: Sequence[Array]
) -> list[Footprint]:
    return [
        *(Footprint(corners, GREEN, 2, is_framed=False) for corners in truth_corners_cam),
        *(Footprint(car.corners_cam, ORANGE) for car in before),
        *(Footprint(car.corners_cam, BLUE if car.is_refined else GREY, 2, car.label) for car in after),
    ]


def _initial_cars(loaded: LoadedFrame, result: RefinementResult) -> list[DrawnCar]:
    """The mean shape at the pose of the detection, with the detection's box."""
    detections, prior = loaded.detections, result.prior
    T_cam_obj = detections.T_cam_obj.double()
    corners = box_corners(T_cam_obj, detections.dimensions_hwl.double()).numpy()
    mean = sdf_to_mesh(prior.values(prior.initial_code(1))[0], prior.origin, prior.spacing_m)
    cars = []
    for car, detected in enumerate(loaded.detected_objects):
        T = T_cam_obj[car].numpy()
        surface = Surface(mean.vertices @ T[:3, :3].T + T[:3, 3], mean.faces)
        cars.append(DrawnCar(corners[car], surface, str(detected.line_number)))
    return cars


def refined_cars(loaded: LoadedFrame, result: RefinementResult) -> list[DrawnCar]:
    """The refined shape with the box of the result file; the initial state where there is none."""
    boxes = result.boxes()
    statuses, refined = result.status, result.refined.tolist()
    t_cam_ref = loaded.frame.camera.t_cam_ref[0].double()
    location_cam = boxes.location_ref.detach().double().cpu() + t_cam_ref
    T_cam_box = pose_from_kitti(location_cam, boxes.rotation_y.detach().double().cpu())
    corners = box_corners(T_cam_box, boxes.dimensions_hwl.detach().double().cpu()).numpy()
    cars = []
    for row, initial in enumerate(_initial_cars(loaded, result)):
        note = statuses[row].name
        if refined[row]:
            mesh = result.mesh(row)
            cars.append(DrawnCar(corners[row], Surface(mesh.vertices, mesh.faces), initial.label, note))
        else:
            cars.append(replace(initial, note=note, is_refined=False))
    return cars


def _true_corners(loaded: LoadedFrame) -> list[Array]:
    """Corners of the labelled boxes of the classes that were refined."""
    classes = {one.type for one in loaded.detected_objects}
    labels = [label for label in loaded.labels or () if label.type in classes and label.has_box_3d]
    return list(box_corners_cam(labels, loaded.frame.camera.t_cam_ref[0]).numpy())


_TILE_HEIGHTS_PX = (150, 135, 120)
# Width of a tile as a share of its height.
_LEAST_ASPECT, _LARGEST_ASPECT = 0.95, 2.2
_CAPTION_LINE_PX = 26
_GAP_PX = 6
_TILE_GROUND = 24


@dataclass(frozen=True)
class CarTile:
    """One car in two states, the colour of the second, and the lines of its caption."""

    before: Surface
    after: Surface
    colour_after: Colour
    caption: tuple[str, ...]


def tile_strip(
    image: Picture,
    K: Array,  # (3, 3)
    tiles: Sequence[CarTile],
    width_px: int,
) -> Picture:
    """All cars that are seen in the image, side by side; (h, width_px, 3).

    Tiles are made a little smaller where that saves a second row, else they wrap into as many rows as needed.
    """
    for height_px in _TILE_HEIGHTS_PX:
        rows = _wrapped([_tile(image, K, tile, height_px) for tile in tiles], width_px)
        if len(rows) <= 1:
            break
    else:
        rows = _wrapped([_tile(image, K, tile, _TILE_HEIGHTS_PX[0]) for tile in tiles], width_px)
    strips = [_row(row, width_px) for row in rows]
    return np.concatenate(strips) if strips else np.zeros((0, width_px, 3), np.uint8)


def _wrapped(pictures: Sequence[Picture | None], width_px: int) -> list[list[Picture]]:
    """Rows of pictures that fit the width; a row holds at least one."""
    rows: list[list[Picture]] = []
    used = width_px
    for picture in pictures:
        if picture is None:
            continue
        if not rows or used + picture.shape[1] > width_px:
            rows.append([])
            used = 0
        rows[-1].append(picture)
        used += picture.shape[1] + _GAP_PX
    return rows


def _row(pictures: Sequence[Picture], width_px: int) -> Picture:
    row = np.full((pictures[0].shape[0] + _GAP_PX, width_px, 3), _TILE_GROUND, np.uint8)
    u = 0
    for picture in pictures:
        shown = picture[:, : width_px - u]
        row[_GAP_PX:, u : u + shown.shape[1]] = shown
        u += picture.shape[1] + _GAP_PX
    return row


def _tile(image: Picture, K: Array, tile: CarTile, height_px: int) -> Picture | None:
    """Caption, before, after; None for a car that the image does not show."""
    window = _window(image, K, (tile.before, tile.after))
    if window is None:
        return None
    scale = height_px / (window[3] - window[1])
    states: list[tuple[Surface, Colour]] = [(tile.before, ORANGE), (tile.after, tile.colour_after)]
    views = []
    for surface, colour in states:
        view = View.of_window(image, K, window, scale)
        draw_contour(view, surface, colour, 1)
        views.append(view.picture)
    width = views[0].shape[1]
    caption = np.full((_CAPTION_LINE_PX * len(tile.caption) + 4, width, 3), _TILE_GROUND, np.uint8)
    for line, text in enumerate(tile.caption):
        draw_text(caption, text, (3, _CAPTION_LINE_PX * (line + 1) - 5), size=text_size_for(text, width - 6, 0.8))
    return np.concatenate([caption, *views])


def _window(image: Picture, K: Array, surfaces: Sequence[Surface]) -> tuple[int, int, int, int] | None:
    """The part of the image around both states, of a shape that makes a handy tile."""
    points = np.concatenate([surface.vertices_cam for surface in surfaces])
    points = points[points[:, 2] > NEAR_PLANE_M]
    if not len(points):
        return None
    height, width = image.shape[:2]
    pixels = np.clip(View(image, K).project(points), 0, [width - 1, height - 1])
    (u0, v0), (u1, v1) = pixels.min(axis=0), pixels.max(axis=0)
    if u1 - u0 < 1 or v1 - v0 < 1:
        return None
    tall = max(1.3 * max(v1 - v0, 6.0), 1.15 * (u1 - u0) / _LARGEST_ASPECT)
    wide = max(1.15 * (u1 - u0), _LEAST_ASPECT * tall)
    u, v = (u0 + u1) / 2, (v0 + v1) / 2
    return round(u - wide / 2), round(v - tall / 2), round(u + wide / 2), round(v + tall / 2)
