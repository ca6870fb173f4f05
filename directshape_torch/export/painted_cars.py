"""Surfaces and surface points of refined cars with the colours of the left image."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from directshape_torch.evaluation.shape_truth import EstimatedCar
from directshape_torch.export.visible_surface import FrameView, Points
from directshape_torch.io.run_folder import FrameResult
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.observation.extents import MASK_THRESHOLD
from directshape_torch.shape.sdf_to_mesh import sdf_to_mesh
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.visualize.drawing import picture_of

if TYPE_CHECKING:
    import trimesh

NEUTRAL_RGB = (150, 150, 150)
NEUTRAL, MIRRORED, SEEN = 0, 1, 2
"""Where a colour comes from: nowhere, the other side of the car, the image."""

# A vertex has one colour, so the mesh is made finer until an edge is about as long as this in the image.
_EDGE_PX = 2.5
_MOST_SUBDIVISIONS = 2
# How far from the mirrored place a seen point may lie to lend its colour; about an edge of the mesh.
_MIRROR_REACH_M = 0.12
_SEED = 0


@dataclass(frozen=True)
class Paint:
    """Colours of N surface points.

    Attributes:
        rgb: (N, 3) uint8, sRGB.
        source: (N,) uint8: 2 seen in the image, 1 mirrored by the car's plane of symmetry, 0 neutral grey.
    """

    rgb: NDArray[np.uint8]
    source: NDArray[np.uint8]


@dataclass(frozen=True)
class SurfaceSamples:
    """N points spread evenly by area over the whole closed surface of a car.

    Attributes:
        points_cam: (N, 3) metres, left camera frame.
        normals_cam: (N, 3) outward, of the mesh's triangles.
        paint: their colours.
    """

    points_cam: Points
    normals_cam: Points
    paint: Paint


class PaintedFrame:
    """The refined cars of a frame with the colours of its left image.

    Args:
        frame: what the run left.
        prior: the one that the refinement used.
        loaded: the frame's images, calibration and masks; None leaves everything neutral.
        mirror: give a point that is not seen the colour of its mirror image where that is seen.
    """

    def __init__(self, frame: FrameResult, prior: ShapePrior, loaded: LoadedFrame | None, mirror: bool = True) -> None:
        self.frame, self.prior, self.mirror = frame, prior, mirror
        self.objects = frame.refined_cars
        shapes = frame.shapes
        self.cars = [
            EstimatedCar(prior, torch.from_numpy(shapes.codes[o.car]), torch.from_numpy(shapes.T_cam_obj[o.car]))
            for o in self.objects
        ]
        self.view = None if loaded is None else frame_view(frame, loaded, self.cars)

    def mesh(self, index: int, finer: bool = False) -> tuple[trimesh.Trimesh, Paint]:
        """Surface of the refined car `index` in the left camera frame, and the colours of its vertices.

        Args:
            index: place among `objects`.
            finer: divide the triangles, without moving the surface, until the colours are as fine as the image.
        """
        mesh = self._mesh(index)
        if finer and self.view is not None:
            mesh = _subdivided(mesh, self.view)
        return mesh, self.paint(index, mesh.vertices, mesh.vertex_normals)

    def samples(self, index: int, count: int) -> SurfaceSamples:
        """`count` points of the surface of the refined car `index`, always the same ones."""
        from trimesh.sample import sample_surface

        mesh = self._mesh(index)
        points, faces = sample_surface(mesh, count, seed=_SEED)[:2]
        points_cam, normals_cam = np.asarray(points, dtype=np.float64), np.asarray(mesh.face_normals[faces])
        return SurfaceSamples(points_cam, normals_cam, self.paint(index, points_cam, normals_cam))

    def paint(self, index: int, points_cam: Points, normals_cam: Points) -> Paint:
        """Colours of points on the surface of a car; see `FrameView.is_seen`."""
        paint = Paint(np.full((len(points_cam), 3), NEUTRAL_RGB, dtype=np.uint8), np.zeros(len(points_cam), np.uint8))
        if self.view is None:
            return paint
        seen = self.view.is_seen(index, points_cam, normals_cam)
        paint.rgb[seen] = self.view.colours(points_cam[seen])
        paint.source[seen] = SEEN
        if self.mirror:
            _mirror(paint, self._to_object(index, points_cam))
        return paint

    def _mesh(self, index: int) -> trimesh.Trimesh:
        car = self.cars[index]
        values = self.prior.values(car.code[None].to(self.prior.origin))[0]
        return sdf_to_mesh(values, self.prior.origin, self.prior.spacing_m, car.T_cam_obj)

    def _to_object(self, index: int, points_cam: Points) -> Points:
        T_cam_obj = self.cars[index].T_cam_obj.double().numpy()
        return np.asarray((points_cam - T_cam_obj[:3, 3]) @ T_cam_obj[:3, :3])


def frame_view(frame: FrameResult, loaded: LoadedFrame, cars: list[EstimatedCar]) -> FrameView:
    """The left image of a frame with its refined cars and the masks that were found for them."""
    masks = masks_of_lines(loaded)
    return FrameView(
        picture_of(loaded.frame.images_left[0]),
        loaded.frame.camera.K_left[0].double().cpu().numpy(),
        cars,
        [masks.get(one.line.line_number) for one in frame.refined_cars],
    )


def masks_of_lines(loaded: LoadedFrame) -> Mapping[int, NDArray[np.bool_]]:
    """The left mask (H, W) of each line that has one, without its outermost pixels, which also show what is beside."""
    import cv2

    detections, masks = loaded.detections, {}
    for row, detected in enumerate(loaded.detected_objects):
        if bool(detections.has_mask_left[row]):
            mask = (detections.mask_left[row] > MASK_THRESHOLD).numpy().astype(np.uint8)
            inner = cv2.erode(mask, np.ones((3, 3), np.uint8), borderValue=1)
            masks[detected.line_number] = inner.astype(bool)
    return masks


def _subdivided(mesh: trimesh.Trimesh, view: FrameView) -> trimesh.Trimesh:
    import trimesh

    subdivide: Callable[..., tuple[NDArray[Any], ...]] = trimesh.remesh.subdivide
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    depth = max(float(mesh.vertices[:, 2].mean()), 1.0)
    edge_px = float(mesh.edges_unique_length.mean()) * float(view.K_left[0, 0]) / depth
    times = int(np.clip(np.ceil(np.log2(edge_px / _EDGE_PX)), 0, _MOST_SUBDIVISIONS))
    for _ in range(times):
        vertices, faces = subdivide(vertices, faces)[:2]
    return trimesh.Trimesh(vertices, faces, process=False)


def _mirror(paint: Paint, points_obj: Points) -> None:
    """Lend each unseen point the colour of the seen point next to its mirror image (x, y, -z) in the object frame."""
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
