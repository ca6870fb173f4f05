"""Completeness, accuracy, F1 and RMSE of estimated surfaces against true ones, as points that a mask's pixels show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.geometry import se3
from directshape_torch.geometry.camera import rays_from_pixels
from directshape_torch.geometry.projection import depth_from_disparity
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.io.frame_detections import match_masks
from directshape_torch.io.image_files import read_disparity, read_single_channel
from directshape_torch.io.instance_masks import MaskSource
from directshape_torch.io.kitti_labels import KittiObject
from directshape_torch.refinement.ray_cast import cast
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.terms.cars import CarState

Points = NDArray[np.float64]

_SAMPLES_PER_RAY = 96
TAUS_M = tuple(k / 20 for k in range(1, 21))
"""Distances within which a point counts as matched, metres: 0.05, 0.1 .. 1.0."""


@dataclass(frozen=True)
class ShapeError:
    """Matches between the true and the estimated points of one car at T distances tau."""

    taus_m: NDArray[np.float64]  # (T,)
    num_true: int
    num_estimated: int
    num_true_matched: NDArray[np.int64]  # (T,) true points with an estimated point within tau
    num_estimated_matched: NDArray[np.int64]  # (T,) estimated points with a true point within tau
    squared_distances_m2: NDArray[np.float64]  # (T,) of the matched true points to their closest estimates, sum

    @property
    def completeness(self) -> NDArray[np.float64]:
        """Share (T,) of the true points that are matched."""
        return self.num_true_matched / self.num_true

    @property
    def accuracy(self) -> NDArray[np.float64]:
        """Share (T,) of the estimated points that are matched; 0 where there are no estimated points."""
        return self.num_estimated_matched / max(1, self.num_estimated)

    @property
    def f1(self) -> NDArray[np.float64]:
        """Harmonic mean (T,) of completeness and accuracy; 0 where both are."""
        total = self.completeness + self.accuracy
        return 2 * self.completeness * self.accuracy / np.where(total > 0, total, 1.0)

    @property
    def rmse_m(self) -> NDArray[np.float64]:
        """Root mean square (T,) of the distances of the matched true points, metres; NaN where none is matched."""
        mean = self.squared_distances_m2 / np.maximum(1, self.num_true_matched)
        return np.where(self.num_true_matched > 0, np.sqrt(mean), np.nan)


def shape_error(
    true_points: Points,  # (N, 3)
    estimated_points: Points,  # (M, 3)
    taus_m: Sequence[float] = TAUS_M,
) -> ShapeError:
    """Compare two sets of points of one car (paper, section IV.B).

    The paper: "we measure completeness (% of ground-truth (GT) points with at least one estimated point within a
    certain distance tau), accuracy (% of estimated points with at least one GT point within tau) and F1 score
    (2 completeness accuracy / (completeness + accuracy)) for the GT segments in the KITTI Stereo 2015 benchmark. To
    more precisely measure the accuracy, we additionally compute the RMSE: For each GT point, we search within tau and
    compute the distance to the closest estimate point. The RMSE is only computed for those GT points with matched
    estimated points."

    It leaves open, and here it is: "within" is at most tau; distances are Euclidean, in 3D; without any match F1 is 0
    and RMSE undefined; what the points of a surface are, and how cars are averaged, is for the caller (see
    `evaluate_shapes`). RMSE must be read beside completeness: an estimate that matches few points may have a small one.

    Args:
        true_points: N >= 1, metres, in any frame.
        estimated_points: in the same frame; M = 0 matches nothing.
        taus_m: distances, metres, above 0.

    Raises:
        InputError: no true points, a wrong shape, numbers that are not finite, or a tau that is not above 0.

    Examples:
        >>> error = shape_error(np.array([[0.0, 0, 0], [1, 0, 0]]), np.array([[0.0, 0, 0.3]]), taus_m=(0.2, 0.5))
        >>> error.completeness, error.accuracy, error.rmse_m
        (array([0. , 0.5]), array([0., 1.]), array([nan, 0.3]))
    """
    from scipy.spatial import cKDTree

    taus = np.asarray(taus_m, dtype=np.float64)
    if taus.ndim != 1 or not (taus > 0).all():
        raise InputError("taus_m", "distances above 0, shape (T,)", str(taus_m))
    true, estimated = _checked("true_points", true_points), _checked("estimated_points", estimated_points)
    if not len(true):
        raise InputError("true_points", "at least one point", "none")
    to_estimated = cKDTree(estimated).query(true)[0] if len(estimated) else np.full(len(true), np.inf)
    to_true = cKDTree(true).query(estimated)[0] if len(estimated) else np.zeros(0)
    matched = to_estimated <= taus[:, None]
    return ShapeError(
        taus_m=taus,
        num_true=len(true),
        num_estimated=len(estimated),
        num_true_matched=matched.sum(axis=1),
        num_estimated_matched=(to_true <= taus[:, None]).sum(axis=1),
        squared_distances_m2=np.square(np.where(matched, to_estimated, 0.0)).sum(axis=1),
    )


def _checked(name: str, points: Points) -> Points:
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(name, "shape (N, 3)", str(points.shape))
    if not np.isfinite(points).all():
        raise InputError(name, "finite coordinates", "NaN or infinity")
    return points


@dataclass(frozen=True)
class EstimatedCar:
    """One car as a refinement sees it."""

    prior: ShapePrior  # the family of shapes
    code: Tensor  # (K,) standard deviations
    T_cam_obj: Tensor  # (4, 4)

    def points_at_pixels(
        self,
        uv_left: NDArray[np.float64],  # (P, 2)
        K_left: Tensor,  # (3, 3)
    ) -> Points:  # (P, 3)
        """Where the rays of left pixels first meet the surface, left camera frame, metres; NaN where they miss it."""
        like, rays_cam = self.prior.origin, rays_from_pixels(torch.from_numpy(uv_left), K_left.double())
        state = CarState.of(se3.inverse(self.T_cam_obj.double())[None].to(like), self.code[None].to(like))
        depth = cast(self.prior, state, torch.zeros_like(like), rays_cam.to(like), _SAMPLES_PER_RAY).depth
        return np.asarray(depth.double().cpu()[:, None] * rays_cam)


@dataclass(frozen=True)
class SegmentTruth:
    """The N pixels inside the segment of one car whose true depth is known.

    One ray is cast for each of these pixels, so a shape that fits perfectly gives the true points themselves.
    """

    segment: str  # which pixels these are, for reports
    uv_left: NDArray[np.float64]  # (N, 2) pixels of the left image
    points_cam: Points  # (N, 3) left camera frame, metres
    K_left: Tensor  # (3, 3) pixels

    def errors(self, car: EstimatedCar) -> ShapeError:
        """Errors of an estimated car."""
        points_cam = car.points_at_pixels(self.uv_left, self.K_left)
        return shape_error(self.points_cam, points_cam[np.isfinite(points_cam).all(axis=1)])


@dataclass(frozen=True)
class SegmentSource:
    """Disparity or depth maps of a data set and the masks that say which pixels belong to a car.

    The segment of a label is the mask of the left image of largest overlap with its 2D box (at least 0.3, one to one).

    Args:
        training: folder with `disp_occ_0/NNNNNN.png` (disparity x 256), or else `depth_2/NNNNNN.png` (metres x 256),
            16 bits, 0 where unknown.
        masks: of the left images.

    Raises:
        DataFormatError: neither folder is there.
    """

    training: Path
    masks: MaskSource

    def __post_init__(self) -> None:
        if not self.folder.is_dir():
            raise DataFormatError(self.training, "holds neither disp_occ_0 nor depth_2", cure="give true disparities")

    @property
    def folder(self) -> Path:
        """Of the maps."""
        disparities = self.training / "disp_occ_0"
        return disparities if disparities.is_dir() else self.training / "depth_2"

    def frame_ids(self) -> tuple[str, ...]:
        """The frames that have a map."""
        return tuple(sorted(path.stem for path in self.folder.glob("*.png")))

    def truths(
        self, frame_id: str, labels: Sequence[KittiObject], camera: StereoCamera
    ) -> Mapping[int, SegmentTruth]:  # by line number of the label
        """The segments of the labels of a frame that have a mask with known depths in it.

        Raises:
            DataFormatError: the map or the masks are missing or damaged.
        """
        path = self.folder / f"{frame_id}.png"
        depth = read_depth(path) if self.folder.name == "depth_2" else _depth_of(read_disparity(path), camera)
        masks = [mask for mask in self.masks.read(frame_id, depth.shape) if mask.side == "left"]
        boxes = np.array([label.box_2d for label in labels], dtype=np.float64).reshape(-1, 4)
        found: dict[int, SegmentTruth] = {}
        for label, index in zip(labels, match_masks(boxes, masks)[0], strict=True):
            if index >= 0:
                inside = np.asarray(masks[index].probability) > 0.5
                truth = segment_truth(f"left mask {masks[index].instance_id}", depth, inside, camera)
                if len(truth.points_cam):
                    found[label.line_number] = truth
        return found


def segment_truth(
    name: str,
    depth_m: NDArray[np.float64],  # (H, W) along the optical axis, NaN where unknown
    inside: NDArray[np.bool_],  # (H, W)
    camera: StereoCamera,  # of one frame
) -> SegmentTruth:
    """The true points of the pixels of a segment whose depth is known."""
    v, u = np.nonzero(inside & np.isfinite(depth_m))
    uv, K_left = np.stack([u, v], axis=-1).astype(np.float64), camera.K_left[0].double()
    rays_cam = rays_from_pixels(torch.from_numpy(uv), K_left).numpy()
    return SegmentTruth(name, uv, depth_m[v, u, None] * rays_cam, K_left)


def read_depth(path: Path) -> NDArray[np.float64]:
    """A map of 16 bits, metres times 256, as (H, W) metres, NaN where it is 0."""
    values = read_single_channel(path)
    if values.dtype != np.uint16:
        raise DataFormatError(path, f"expected 16 bits (metres times 256), got {values.dtype}")
    return np.where(values > 0, values / 256.0, np.nan)


def _depth_of(disparity: NDArray[np.floating[Any]], camera: StereoCamera) -> NDArray[np.float64]:
    """Metres; the residual disparity field of a rig plays no part: it corrects what a pair measures, not the truth."""
    height, width = disparity.shape
    uv = torch.from_numpy(np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float64))
    K_left, K_right, T_right_cam = (x[0].double() for x in (camera.K_left, camera.K_right, camera.T_right_cam))
    known = np.where(disparity > 0, disparity, np.nan).astype(np.float64)
    return depth_from_disparity(uv, torch.from_numpy(known), K_left, K_right, T_right_cam).numpy()
