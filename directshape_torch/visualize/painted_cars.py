"""This module colours surfaces of refined cars by the left image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.evaluation.shape_error import EstimatedCar
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.scene.masks import MASK_THRESHOLD
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.visualize.drawing import View
from directshape_torch.visualize.drawn_car import DrawnCar

if TYPE_CHECKING:
    import trimesh

Points = NDArray[np.float64]

NEUTRAL_RGB = (150, 150, 150)
NEUTRAL, MIRRORED, SEEN = 0, 1, 2
"""These are the sources of a colour: none, the other side of the car, the image."""

# A vertex has one colour, so the mesh is refined until an edge has about this length in the image.
_EDGE_PX = 2.5
_MOST_SUBDIVISIONS = 2
# A seen point within this distance of a mirrored point lends it its colour; it is about an edge of the mesh.
_MIRROR_REACH_M = 0.12
# A point this much deeper than the first surface on its ray still counts as visible, since mesh and field differ.
_SAME_SURFACE_M = 0.03
# At more grazing views a small error of the fit would take colours from beside the car.
_LEAST_RAY_COSINE = 0.2
# These are sizes of the grid on the ground.
_SPACING_M, _STRIP_WIDTH_M = 5.0, 0.04
_X_M, _Z_M = (-20.0, 20.0), (0.0, 50.0)


@dataclass(frozen=True)
class FrameView:
    """A `FrameView` is the left image of a frame with the refined cars in it."""

    left: View
    cars: Sequence[EstimatedCar]  # they may hide themselves and one another
    masks: Sequence[NDArray[np.bool_] | None]  # (H, W) left pixels that show each car, None if unknown

    def is_seen(
        self,
        car: int,
        points_cam: Points,  # (N, 3) on the surface of the car, metres
        normals_cam: Points,  # (N, 3) outward
    ) -> NDArray[np.bool_]:  # (N,)
        """Whether points are visible: facing the camera, in the image, on the car's mask, and not hidden by a car."""
        distance = np.linalg.norm(points_cam, axis=1)
        cosine = -(points_cam * normals_cam).sum(axis=1) / np.maximum(distance, 1e-9)
        height, width = self.left.picture.shape[:2]
        uv, mask = self.left.project(points_cam), self.masks[car]
        seen = (cosine > _LEAST_RAY_COSINE) & (points_cam[:, 2] > 0)
        seen &= ((uv >= 0) & (uv <= np.array([width - 1, height - 1]))).all(axis=1)
        if mask is not None:
            column, row = np.rint(uv[seen]).astype(np.int64).T
            seen[seen] = mask[row, column]
        for other in (car, *(row for row in range(len(self.cars)) if row != car)):
            rows = np.flatnonzero(seen)
            depth = self.cars[other].points_at_pixels(uv[rows].astype(np.float64), torch.from_numpy(self.left.K))[:, 2]
            # A ray that misses a car has depth NaN, which hides nothing.
            seen[rows[depth < points_cam[rows, 2] - _SAME_SURFACE_M]] = False
        return np.asarray(seen)

    def colours(self, points_cam: Points) -> NDArray[np.uint8]:
        """The image's colours (N, 3) at the points, sRGB, interpolated bilinearly."""
        from scipy.ndimage import map_coordinates

        at, image = self.left.project(points_cam).T[::-1], self.left.picture
        channels = [map_coordinates(image[..., k], at, np.float64, order=1, mode="nearest") for k in range(3)]
        return np.rint(np.stack(channels, axis=1)).astype(np.uint8)


class Paint(NamedTuple):
    """A `Paint` has the colours of N surface points."""

    rgb: NDArray[np.uint8]  # (N, 3) sRGB
    source: NDArray[np.uint8]  # (N,) 2 seen in the image, 1 mirrored at the car's plane of symmetry, 0 neutral grey


class PaintedFrame:
    """A `PaintedFrame` has the refined cars of a frame with the colours of its left image.

    Args:
        cars: refined cars, with their shapes.
        prior: the prior of the refinement.
        loaded: images, calibration and masks of the frame; None gives neutral colours.
    """

    def __init__(self, cars: Sequence[DrawnCar], prior: ShapePrior, loaded: LoadedFrame | None) -> None:
        self.cars, self.view = cars, None
        if loaded is not None:
            masks = _masks_of_lines(loaded)
            fields = [EstimatedCar(prior, torch.from_numpy(c.code), torch.from_numpy(c.T_cam_obj)) for c in cars]
            self.view = FrameView(View.of_frame(loaded.frame), fields, [masks.get(car.line) for car in cars])

    def mesh(self, index: int, finer: bool = False) -> tuple[trimesh.Trimesh, Paint]:
        """Surface of `cars[index]` in the left camera frame, and the colours of its vertices.

        If `finer`, triangles are divided, without a change of the surface, until colours are as fine as the image.
        """
        mesh = self.cars[index].surface
        assert mesh is not None, "the shape of a refined car is known with its prior"
        if finer and self.view is not None:
            mesh = _subdivided(mesh, self.view)
        return mesh, self._paint(index, mesh.vertices, mesh.vertex_normals)

    def _paint(self, index: int, points_cam: Points, normals_cam: Points) -> Paint:
        """Colours of points on the surface of a car; see `FrameView.is_seen`."""
        paint = Paint(np.full((len(points_cam), 3), NEUTRAL_RGB, dtype=np.uint8), np.zeros(len(points_cam), np.uint8))
        if self.view is None:
            return paint
        seen = self.view.is_seen(index, points_cam, normals_cam)
        paint.rgb[seen] = self.view.colours(points_cam[seen])
        paint.source[seen] = SEEN
        T_cam_obj = self.cars[index].T_cam_obj
        _mirror(paint, (points_cam - T_cam_obj[:3, 3]) @ T_cam_obj[:3, :3])
        return paint


def _masks_of_lines(loaded: LoadedFrame) -> dict[int, NDArray[np.bool_]]:
    """The left mask (H, W) of each line that has one, without the outermost pixels, which also show the background."""
    import cv2

    detections, masks = loaded.detections, {}
    for row, detected in enumerate(loaded.detected_objects):
        if bool(detections.has_mask_left[row]):
            mask = (detections.mask_left[row] > MASK_THRESHOLD).numpy().astype(np.uint8)
            inner = cv2.erode(mask, np.ones((3, 3), np.uint8), borderValue=1)
            masks[detected.line_number] = inner.astype(bool)
    return masks


def _subdivided(mesh: trimesh.Trimesh, view: FrameView) -> trimesh.Trimesh:
    depth = max(float(mesh.vertices[:, 2].mean()), 1.0)
    edge_px = float(mesh.edges_unique_length.mean()) * float(view.left.K[0, 0]) / depth
    for _ in range(int(np.clip(np.ceil(np.log2(edge_px / _EDGE_PX)), 0, _MOST_SUBDIVISIONS))):
        mesh = mesh.subdivide()
    return mesh


def _mirror(paint: Paint, points_obj: Points) -> None:
    """Give each unseen point the colour of the seen point near its mirror image (x, y, -z) in the object frame."""
    from scipy.spatial import KDTree

    seen, unseen = np.flatnonzero(paint.source == SEEN), np.flatnonzero(paint.source == NEUTRAL)
    if not len(seen) or not len(unseen):
        return
    mirrored = points_obj[unseen] * np.array([1.0, 1.0, -1.0])
    found_within = KDTree(points_obj[seen]).query(mirrored, distance_upper_bound=_MIRROR_REACH_M)
    distance, nearest = (np.asarray(part) for part in found_within)
    found = np.isfinite(distance)
    paint.rgb[unseen[found]] = paint.rgb[seen[nearest[found]]]
    paint.source[unseen[found]] = MIRRORED


def ground_grid(
    normal: Tensor,  # (3,) pointing up
    offset: float,  # metres
) -> trimesh.Trimesh:
    """Strips of constant x and z, 5 m apart, on the plane `normal . x_cam + offset = 0`, visible from both sides."""
    import trimesh

    n = normal.detach().double().cpu().numpy()
    half = _STRIP_WIDTH_M / 2
    strips = [(x - half, x + half, *_Z_M) for x in np.arange(_X_M[0], _X_M[1] + _SPACING_M / 2, _SPACING_M)]
    strips += [(*_X_M, z - half, z + half) for z in np.arange(_Z_M[0], _Z_M[1] + _SPACING_M / 2, _SPACING_M)]
    xz = np.array([[(x0, z0), (x1, z0), (x1, z1), (x0, z1)] for x0, x1, z0, z1 in strips]).reshape(-1, 2)
    y = -(n[0] * xz[:, 0] + n[2] * xz[:, 1] + offset) / n[1]
    vertices = np.stack([xz[:, 0], y, xz[:, 1]], axis=1)
    # A strip has two triangles for each side. Normals are given, because computed ones would cancel.
    upper = 4 * np.arange(len(strips))[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])
    faces = np.concatenate([upper, upper[..., ::-1]]).reshape(-1, 3)
    up = np.tile(n / np.linalg.norm(n), (len(vertices), 1))
    return trimesh.Trimesh(vertices, faces, vertex_normals=up, process=False)
