"""This module computes completeness, accuracy, F1 and RMSE of estimated surface points against true ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.geometry import se3
from directshape_torch.geometry.projection import rays_from_pixels
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.geometry.stereo_depth import depth_from_disparity
from directshape_torch.io.image_files import read_disparity, read_single_channel
from directshape_torch.io.instance_masks import MaskSource
from directshape_torch.io.kitti_labels import KittiObject
from directshape_torch.io.mask_matching import match_masks
from directshape_torch.numerics.full_precision import full_precision
from directshape_torch.rows import Rays
from directshape_torch.shape.field import field_of
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.terms.depth import closest_of_march, first_hits, march

Points = NDArray[np.float64]

_SAMPLES_PER_RAY = 96
TAUS_M = tuple(k / 20 for k in range(1, 21))
"""These are the distances within which a point counts as matched, metres: 0.05, 0.1 .. 1.0."""


@dataclass(frozen=True)
class ShapeError:
    """A `ShapeError` says how well the true and the estimated points of one car match, at T distances tau."""

    num_true: int
    num_estimated: int
    completeness: NDArray[np.float64]  # (T,) share of true points with an estimated point within tau
    accuracy: NDArray[np.float64]  # (T,) share of estimated points with a true point within tau; 0 without any
    f1: NDArray[np.float64]  # (T,) harmonic mean of completeness and accuracy; 0 if both are 0
    # (T,) root mean square of the distances of matched true points to their closest estimates, metres; NaN without any.
    rmse_m: NDArray[np.float64]


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

    The paper leaves some points open. Here "within" means at most tau, and distances are Euclidean in 3D. Without any
    match F1 is 0 and RMSE is undefined. The caller chooses the points of a surface and how cars are averaged (see
    `evaluate_shapes`). RMSE must be read together with completeness, because an estimate that matches few points may
    have a small RMSE.

    Args:
        true_points: true points, N >= 1, metres, in any frame.
        estimated_points: points in the same frame; with M = 0 nothing is matched.
        taus_m: distances, metres, above 0.

    Raises:
        InputError: there are no true points, a shape is wrong, a number is not finite, or a tau is not above 0.

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
    num_matched = matched.sum(axis=1)
    completeness = num_matched / len(true)
    accuracy = (to_true <= taus[:, None]).sum(axis=1) / max(1, len(estimated))
    total = completeness + accuracy
    squares_m2 = np.square(np.where(matched, to_estimated, 0.0)).sum(axis=1)
    return ShapeError(
        num_true=len(true),
        num_estimated=len(estimated),
        completeness=completeness,
        accuracy=accuracy,
        f1=2 * completeness * accuracy / np.where(total > 0, total, 1.0),
        rmse_m=np.where(num_matched > 0, np.sqrt(squares_m2 / np.maximum(1, num_matched)), np.nan),
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
    """An `EstimatedCar` is one car with its estimated shape and pose."""

    prior: ShapePrior  # the family of shapes
    code: Tensor  # (K,) standard deviations
    T_cam_obj: Tensor  # (4, 4)

    @torch.no_grad()
    @full_precision()
    def points_at_pixels(
        self,
        uv_left: NDArray[np.float64],  # (P, 2)
        K_left: Tensor,  # (3, 3)
    ) -> Points:  # (P, 3)
        """First intersections of rays of left pixels with the surface, left camera frame, metres; NaN for misses."""
        like, rays_cam = self.prior.origin, rays_from_pixels(torch.from_numpy(uv_left), K_left.double())
        field, bounds = field_of(self.prior.bind(self.code[None].to(like))), self.prior.bounds_obj
        # Each ray is a block of its own.
        owner = torch.zeros(len(rays_cam), dtype=torch.long, device=like.device)
        rays_of_blocks = Rays(owner, torch.zeros_like(rays_cam).to(like), rays_cam.to(like).mT[..., None])
        rays = rays_of_blocks.in_objects(se3.inverse(self.T_cam_obj.double())[None].to(like))
        marched = march(field, owner, rays, bounds, _SAMPLES_PER_RAY)
        hits = first_hits(field, owner, rays, marched, closest_of_march(field, owner, rays, bounds, marched))
        depth = torch.where(hits.found, hits.depth, torch.nan)[:, 0]
        return np.asarray(depth.double().cpu()[:, None] * rays_cam)


@dataclass(frozen=True)
class SegmentTruth:
    """A `SegmentTruth` has the N pixels of one car's segment whose true depth is known."""

    segment: str  # description of the segment, for reports
    uv_left: NDArray[np.float64]  # (N, 2) pixels of the left image
    points_cam: Points  # (N, 3) left camera frame, metres
    K_left: Tensor  # (3, 3) pixels

    def errors(self, car: EstimatedCar) -> ShapeError:
        """Errors of an estimated car, with one ray for each pixel, so that a perfect shape gives the true points."""
        points_cam = car.points_at_pixels(self.uv_left, self.K_left)
        return shape_error(self.points_cam, points_cam[np.isfinite(points_cam).all(axis=1)])


def folder_of_maps(training: Path) -> Path:
    """The folder of true maps of 16 bits, with 0 for unknown.

    It is `disp_occ_0` (disparity x 256), else `depth_2` (metres x 256).

    Raises:
        DataFormatError: neither folder exists.
    """
    for folder in (training / "disp_occ_0", training / "depth_2"):
        if folder.is_dir():
            return folder
    raise DataFormatError(training, "holds neither disp_occ_0 nor depth_2", cure="give true disparities")


def segments_of(
    path: Path, masks: MaskSource, labels: Sequence[KittiObject], camera: StereoCamera
) -> dict[int, SegmentTruth]:  # by line number of the label
    """The segments of a frame's labels that have a mask with known depths, by line number of the label.

    The segment of a label is the mask of the left image that is matched to it (`io.mask_matching`).

    Args:
        path: the frame's map, in one of the folders of `folder_of_maps`.
        masks: masks of the left images.
        labels: labels, all with a 3D box, which compete for the masks.
        camera: camera of the frame.

    Raises:
        DataFormatError: the map or the masks are missing or damaged.
    """
    depth = read_depth(path) if path.parent.name == "depth_2" else _depth_of(read_disparity(path), camera)
    found = [mask for mask in masks.read(path.stem, depth.shape) if mask.side == "left"]
    truths: dict[int, SegmentTruth] = {}
    matches = match_masks(labels, found, camera, depth.shape, frozenset(label.type for label in labels))
    for label, mask in zip(labels, matches.left, strict=True):
        if mask is not None:
            truth = segment_truth(f"left mask {mask.instance_id}", depth, mask.whole(depth.shape), camera)
            if len(truth.points_cam):
                truths[label.line_number] = truth
    return truths


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
    """Depths (H, W), metres, from a 16-bit map of metres times 256; 0 (unknown) becomes NaN."""
    stored = read_single_channel(path)
    if stored.dtype != np.uint16:
        raise DataFormatError(path, f"expected 16 bits (metres times 256), got {stored.dtype}")
    return np.where(stored > 0, stored / 256.0, np.nan)


def _depth_of(disparity: NDArray[np.float32], camera: StereoCamera) -> NDArray[np.float64]:
    """Depths in metres without the rig's disparity field, which corrects measured disparities and not the truth."""
    height, width = disparity.shape
    uv = torch.from_numpy(np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float64))
    K_left, K_right, T_right_cam = (x[0].double() for x in (camera.K_left, camera.K_right, camera.T_right_cam))
    return depth_from_disparity(uv, torch.from_numpy(disparity).double(), K_left, K_right, T_right_cam).numpy()
