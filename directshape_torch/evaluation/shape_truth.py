"""Points on estimated cars and on true ones: of disparity maps inside masks, or spread over whole surfaces."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.diagnosis.ray_cast import cast
from directshape_torch.errors import DataFormatError
from directshape_torch.evaluation.shape_error import Points, ShapeError, shape_error
from directshape_torch.files.npz_files import read_npz
from directshape_torch.geometry import se3
from directshape_torch.geometry.camera import points_from_disparity, rays_from_pixels
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.io.disparity_files import read_disparity
from directshape_torch.io.image_files import read_single_channel
from directshape_torch.io.instance_masks import MaskSource
from directshape_torch.io.kitti_labels import KittiObject
from directshape_torch.io.mask_matching import match_masks
from directshape_torch.shape.sdf_to_mesh import sdf_to_mesh
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.terms.cars import CarState

_SAMPLES_PER_RAY = 96


@dataclass(frozen=True)
class EstimatedCar:
    """One car as a refinement sees it.

    Attributes:
        prior: the family of shapes.
        code: (K,) standard deviations.
        T_cam_obj: (4, 4) object to left camera.
    """

    prior: ShapePrior
    code: Tensor
    T_cam_obj: Tensor

    def sampled_points(self, count: int, seed: int) -> Points:
        """`count` points (count, 3) in camera coordinates, uniform by area over the whole closed surface.

        Raises:
            MeshError: the shape has no surface.
        """
        from trimesh.sample import sample_surface

        values = self.prior.values(self._code())[0]
        mesh = sdf_to_mesh(values, self.prior.origin, self.prior.spacing_m, self.T_cam_obj)
        return np.asarray(sample_surface(mesh, count, seed=seed)[0], dtype=np.float64)

    def depth_at_pixels(
        self,
        uv_left: NDArray[np.float64],  # (P, 2)
        K_left: Tensor,  # (3, 3)
    ) -> NDArray[np.float64]:  # (P,)
        """Depth along the optical axis where the rays of left pixels first meet the surface, NaN where they miss it."""
        like = self.prior.origin
        rays_cam = rays_from_pixels(torch.from_numpy(uv_left), K_left.double()).to(like)
        state = CarState.of(se3.inverse(self.T_cam_obj.double())[None].to(like), self._code())
        return np.asarray(
            cast(self.prior, state, torch.zeros_like(like), rays_cam, _SAMPLES_PER_RAY).depth.double().cpu()
        )

    def points_at_pixels(
        self,
        uv_left: NDArray[np.float64],  # (P, 2)
        K_left: Tensor,  # (3, 3)
    ) -> Points:
        """The points of these depths, (Q, 3) in camera coordinates; rays that miss are left out."""
        depth = self.depth_at_pixels(uv_left, K_left)
        rays_cam = rays_from_pixels(torch.from_numpy(uv_left), K_left.double()).numpy()
        hit = np.isfinite(depth)
        return np.asarray(depth[hit, None] * rays_cam[hit])

    def _code(self) -> Tensor:
        return self.code[None].to(self.prior.origin)


FOLDER = "disp_occ_0"


@dataclass(frozen=True)
class SegmentTruth:
    """The true disparities inside the segment of one car.

    One ray is cast for each of these pixels, so a shape that fits perfectly gives the true points themselves.

    Attributes:
        segment: which pixels these are, for reports.
        uv_left: (N, 2) pixels of the left image.
        points_cam: (N, 3) left camera frame, metres.
        K_left: (3, 3) pixels.
    """

    segment: str
    uv_left: NDArray[np.float64]
    points_cam: Points
    K_left: Tensor

    def errors(self, car: EstimatedCar) -> dict[str, ShapeError]:
        """Errors of an estimated car, one surface: "segment"."""
        return {"segment": shape_error(self.points_cam, car.points_at_pixels(self.uv_left, self.K_left))}

    def sampling_limit(self, _: EstimatedCar) -> dict[str, ShapeError]:
        """Nothing: a perfect estimate has no error here."""
        return {}


@dataclass(frozen=True)
class SegmentSource:
    """Disparity maps of a data set and the masks that say which pixels belong to a car.

    No object map is supplied with the data this was built for; the segments are instance masks of the left image, and
    the segment of a label is the mask of largest overlap with its 2D box (at least 0.3, one to one).

    Attributes:
        folder: `training/disp_occ_0` with `NNNNNN.png`.
        masks: of the left images.
    """

    folder: Path
    masks: MaskSource

    def frame_ids(self) -> tuple[str, ...]:
        """The frames that have a disparity map."""
        return tuple(sorted(path.stem for path in self.folder.glob("*.png")))

    def truths(
        self, frame_id: str, labels: Sequence[KittiObject], camera: StereoCamera
    ) -> Mapping[int, SegmentTruth]:  # by line number of the label
        """The segments of the labels of a frame that have a mask with true disparities in it.

        Raises:
            DataFormatError: the disparity map or the masks are missing or damaged.
        """
        disparity = read_disparity(self.folder / f"{frame_id}.png").astype(np.float64)
        masks = [mask for mask in self.masks.read(frame_id, disparity.shape) if mask.side == "left"]
        boxes = np.array([label.box_2d for label in labels], dtype=np.float64).reshape(-1, 4)
        found: dict[int, SegmentTruth] = {}
        for label, index in zip(labels, match_masks(boxes, masks).mask_of_detection, strict=True):
            if index >= 0:
                inside = np.asarray(masks[index].probability) > 0.5
                truth = segment_truth(f"left mask {masks[index].instance_id}", disparity, inside, camera)
                if len(truth.points_cam):
                    found[label.line_number] = truth
        return found


def segment_truth(
    name: str,
    disparity: NDArray[np.float64],  # (H, W) pixels, NaN where unknown
    inside: NDArray[np.bool_],  # (H, W)
    camera: StereoCamera,  # of one frame
) -> SegmentTruth:
    """The true points of the pixels of a segment whose disparity is known.

    The residual disparity field of a rig plays no part: it corrects what a stereo pair measures, and this is not
    measured by it.
    """
    v, u = np.nonzero(inside & (disparity > 0))
    uv = torch.from_numpy(np.stack([u, v], axis=-1).astype(np.float64))
    K_left, K_right, T_right_cam = (x[0].double() for x in (camera.K_left, camera.K_right, camera.T_right_cam))
    known = torch.from_numpy(disparity[v, u])
    points = points_from_disparity(uv, known, K_left, K_right, T_right_cam)
    valid = points.isfinite().all(dim=-1)
    return SegmentTruth(name, uv[valid].numpy(), points[valid].numpy(), K_left)


NUM_ESTIMATED_POINTS = 4000
# Sets of fewer visible points say nothing about a surface.
MINIMUM_VISIBLE_POINTS = 20
_SEED, _LIMIT_SEED = 0, 1
_INSTANCES_FROM = 1000
# How far behind the depth map a point may lie and still be the surface that is seen there.
_DEPTH_MARGIN_M = 0.03


@dataclass(frozen=True)
class SceneDepth:
    """What the left image of a scene shows at every pixel.

    Attributes:
        depth_m: (H, W) along the optical axis, 0 where there is nothing.
        instance: (H, W) 1000 + k for the car of the k-th label line, from 1; less for anything else.
        K_left: (3, 3) pixels.
    """

    depth_m: NDArray[np.float64]
    instance: NDArray[np.int64]
    K_left: NDArray[np.float64]

    def shows(self, points_cam: Points, own: int) -> NDArray[np.bool_]:
        """Which points (N, 3) on the surface of an instance are seen.

        The depth of a slanted surface changes within a pixel, so a point may lie as deep as the deepest of its own car
        in the 3 x 3 pixels around it.
        """
        column, row, in_image = self._pixels(points_cam)
        own_depth = np.where(self.instance == own, self.depth_m, -np.inf)
        padded = np.pad(own_depth, 1, constant_values=-np.inf)
        height, width = own_depth.shape
        window = [padded[dv : dv + height, du : du + width] for dv in range(3) for du in range(3)]
        deepest = np.maximum.reduce(window)[row, column]
        belongs = self.instance[row, column] == own
        return np.asarray(in_image & belongs & (points_cam[:, 2] <= deepest + _DEPTH_MARGIN_M))

    def with_estimate(self, car: EstimatedCar, points_cam: Points, own: int) -> SceneDepth:
        """The image that would show an estimate in place of the true car: the other cars hide what is behind them.

        Estimate and truth are then asked in the same way which of their points are seen, pixel by pixel, so that a
        perfect estimate loses the same points at its outline. Before and behind the background it is seen: there it
        shows what is not there.

        Args:
            car: the estimate.
            points_cam: (N, 3) points all over its surface, which say where in the image it may be.
            own: number of the instance.
        """
        column, row, _ = self._pixels(points_cam)
        rows = slice(max(0, row.min() - 1), row.max() + 2)
        columns = slice(max(0, column.min() - 1), column.max() + 2)
        v, u = np.mgrid[: self.depth_m.shape[0], : self.depth_m.shape[1]][:, rows, columns]
        uv = np.stack([u.ravel(), v.ravel()], axis=-1).astype(np.float64)
        depth, instance = self.depth_m.copy(), np.where(self.instance == own, 0, self.instance)
        car_depth = car.depth_at_pixels(uv, torch.from_numpy(self.K_left)).reshape(u.shape)
        is_hidden = (instance[rows, columns] >= _INSTANCES_FROM) & (depth[rows, columns] < car_depth)
        shown = np.isfinite(car_depth) & ~is_hidden
        depth[rows, columns][shown] = car_depth[shown]
        instance[rows, columns][shown] = own
        return SceneDepth(depth, instance, self.K_left)

    def _pixels(self, points_cam: Points) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
        in_front = points_cam[:, 2] > 0
        projected = points_cam @ self.K_left.T
        uv = np.rint(projected[:, :2] / np.where(in_front, projected[:, 2], 1.0)[:, None])
        limit = np.array(self.depth_m.shape[::-1]) - 1
        in_image = in_front & (uv >= 0).all(axis=1) & (uv <= limit).all(axis=1)
        column, row = np.clip(uv, 0, limit).astype(np.int64).T
        return column, row, in_image


@dataclass(frozen=True)
class SurfaceTruth:
    """Points on the true surface of one car, uniform by area.

    Attributes:
        segment: which pixels show it, for reports.
        points_cam: (N, 3) left camera frame, metres.
        visible: (N,) bool, seen in the left image.
        scene: what that image shows.
        own: number of the car's instance in it.
    """

    segment: str
    points_cam: Points
    visible: NDArray[np.bool_]
    scene: SceneDepth
    own: int

    def errors(self, car: EstimatedCar) -> dict[str, ShapeError]:
        """Errors of 4000 points of an estimated car: on the "whole" surface, and of the "visible" parts of both."""
        return self._compare(self.points_cam, self.visible, car)

    def sampling_limit(self, car: EstimatedCar) -> dict[str, ShapeError]:
        """Errors of a car against as many other points of its own surface: what a perfect estimate would have."""
        others = car.sampled_points(NUM_ESTIMATED_POINTS, _LIMIT_SEED)
        seen = np.flatnonzero(self._seen(car, others))[: int(self.visible.sum())]
        kept = np.union1d(seen, np.arange(min(len(self.points_cam), len(others))))
        return self._compare(others[kept], np.isin(kept, seen), car)

    def _compare(self, true: Points, visible: NDArray[np.bool_], car: EstimatedCar) -> dict[str, ShapeError]:
        points = car.sampled_points(NUM_ESTIMATED_POINTS, _SEED)
        errors = {"whole": shape_error(true, points)}
        if visible.sum() >= MINIMUM_VISIBLE_POINTS:
            errors["visible"] = shape_error(true[visible], points[self._seen(car, points)])
        return errors

    def _seen(self, car: EstimatedCar, points_cam: Points) -> NDArray[np.bool_]:
        return self.scene.with_estimate(car, points_cam, self.own).shows(points_cam, self.own)


@dataclass(frozen=True)
class SurfaceSource:
    """Surface points, depth maps and instance images of rendered scenes.

    Attributes:
        training: folder with `points/NNNNNN_LINE.npz` (array `points` (N, 3) in `ref`, the frame of the labels; LINE of
            the label file, from 1), `depth_2/NNNNNN.png` (depth x 256) and `instance_2/NNNNNN.png`.
    """

    training: Path

    def frame_ids(self) -> tuple[str, ...]:
        """The frames that have surface points."""
        return tuple(sorted({path.stem.split("_")[0] for path in (self.training / "points").glob("*_*.npz")}))

    def truths(
        self, frame_id: str, labels: Sequence[KittiObject], camera: StereoCamera
    ) -> Mapping[int, SurfaceTruth]:  # by line number of the label
        """The surfaces of the labels of a frame that have points.

        Raises:
            DataFormatError: a file is missing or damaged.
        """
        scene = self._scene(frame_id, camera.K_left[0])
        found = {}
        for label in labels:
            path = self.training / "points" / f"{frame_id}_{label.line_number}.npz"
            if path.is_file():
                points_cam = read_surface_points(path) + camera.t_cam_ref[0].double().numpy()
                own = _INSTANCES_FROM + label.line_number
                visible = scene.shows(points_cam, own)
                found[label.line_number] = SurfaceTruth(f"instance {own}", points_cam, visible, scene, own)
        return found

    def _scene(self, frame_id: str, K_left: Tensor) -> SceneDepth:
        paths = [self.training / folder / f"{frame_id}.png" for folder in ("depth_2", "instance_2")]
        depth, instance = (read_single_channel(path) for path in paths)
        if depth.dtype != np.uint16:
            raise DataFormatError(paths[0], f"expected 16 bits (metres times 256), got {depth.dtype}")
        if depth.shape != instance.shape:
            raise DataFormatError(paths[1], f"has shape {instance.shape}, the depth map {depth.shape}")
        return SceneDepth(depth / 256.0, instance.astype(np.int64), K_left.double().numpy())


def read_surface_points(path: Path) -> Points:
    """The array `points` (N, 3) of an npz file, metres, float64.

    Raises:
        DataFormatError: no such file or array, another shape, no points, or numbers that are not finite.
    """
    arrays = read_npz(path)
    if "points" not in arrays:
        raise DataFormatError(path, f"is no npz file with an array 'points', it has {sorted(arrays)}")
    points = arrays["points"]
    if points.ndim != 2 or points.shape[1] != 3 or not len(points):
        raise DataFormatError(path, f"expected 'points' of shape (N, 3), got {points.shape}")
    if points.dtype.kind != "f" or not np.isfinite(points).all():
        raise DataFormatError(path, "holds points that are not finite numbers")
    return points.astype(np.float64)
