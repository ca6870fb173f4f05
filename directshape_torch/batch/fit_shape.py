"""This module fits shape and pose of cars to points in boxes, without images, by the point term and the priors."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from directshape_torch.config import PointCloudConfig, RefinerConfig, RigConfig
from directshape_torch.geometry import se3
from directshape_torch.geometry.box_formats import BoxFormat, box_form, boxes_to_poses
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.numerics.checks import check_shape
from directshape_torch.numerics.conversion import Given, as_floating
from directshape_torch.numerics.full_precision import full_precision
from directshape_torch.numerics.tables import Chosen
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.rows import PointSamples
from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import FrameBatch
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.state.cars import CarBatch
from directshape_torch.status import Status
from directshape_torch.terms.point_cloud import PointCloud

# Each car is fitted in the frame of its own virtual camera, 10 m from the car and 1.65 m above the ground of its box.
_CAMERA_HEIGHT_M, _DISTANCE_M = 1.65, 10.0
# Points up to this distance outside a box may belong to the car, because detectors err. Points near the ground belong
# to the road.
_BEYOND_BOX_M = 0.4
_LEAST_HEIGHT_M = 0.15
_LEAST_POINTS, _MOST_POINTS = 30, 1000
# This is the weight of the points of a car against the priors, per square metre.
_WEIGHT = 300.0


@dataclass(frozen=True)
class ShapeFit:
    """A `ShapeFit` has N cars fitted to points.

    Attributes:
        cars: poses, codes, boxes and meshes; `cam` in their names means the frame of the points. The status is
            `too_few_points` for cars with fewer than 30. Mask figures are NaN. Standard deviations are only relative,
            because they are calibrated for images.
        num_points: number of points (N,) of each car.
        distance_before_m, distance_after_m: mean distance (N,) of these points to the surface of the mean car in the
            given box, and of the fitted car; NaN for cars without points.
    """

    cars: RefinementResult
    num_points: Tensor
    distance_before_m: Tensor
    distance_after_m: Tensor


@full_precision()
def fit_shape(
    points: Given,  # (P, 3) metres
    boxes: Given,  # (N, 7) or (N, 8, 3)
    convention: BoxFormat = "mmdet3d_lidar",
    prior: ShapePrior | None = None,
) -> ShapeFit:
    """Fit a pose and a shape to the points in each box.

    Args:
        points: points of a LiDAR or any other sensor, in the frame of the boxes.
        boxes: boxes in the format of a detector (`directshape_torch.geometry.box_formats`).
        convention: format of the boxes.
        prior: shape prior. Default: the bundled one.

    Raises:
        InputError: points or boxes have another shape or type.

    Examples:
        >>> ring = torch.linspace(0, 2 * math.pi, 200)
        >>> points = torch.stack([2.0 * ring.cos(), 0.8 * ring.sin(), torch.full_like(ring, -0.9)], dim=1)
        >>> fit = fit_shape(points, torch.tensor([[0.0, 0.0, -1.6, 4.2, 1.7, 1.5, 0.0]]))
        >>> fit.cars.status[0].is_refined, fit.num_points
        (True, tensor([200]))
    """
    points, boxes = as_floating(points), as_floating(boxes)
    check_shape("points", points, ("P", 3), kind="floating")
    T_points_obj, hwl = boxes_to_poses(boxes, convention, torch.eye(4))  # their frame takes the place of the camera
    points = points.to(boxes)
    frames, detections = _scene(hwl)
    T_cam_obj = detections.T_cam_obj
    samples, T_cam_points = _points_of_boxes(points, T_points_obj, T_cam_obj, hwl)
    fitter = _fitter(prior, samples).to(boxes)
    with torch.no_grad():
        fitted = _without_points_unknown(fitter(frames, detections), samples.counts, T_cam_obj)
        before = replace(fitted, T_cam_obj=T_cam_obj, code=fitter.prior.initial_code(len(boxes)).to(boxes))
        distances = [_distances(samples, cars) for cars in (before, fitted)]
    T_points_cam = se3.inverse(T_cam_points)
    kept = torch.where(fitted.refined[:, None, None], T_points_cam @ fitted.T_cam_obj, T_points_obj)
    J_points_cam = torch.eye(4).to(fitted.covariance_xyz_yaw).repeat(len(kept), 1, 1)
    J_points_cam[:, :3, :3] = T_points_cam[:, :3, :3]
    J_points_cam[:, 3, 3] = -1 if box_form(convention).upright else 1
    covariance = J_points_cam @ fitted.covariance_xyz_yaw @ J_points_cam.mT
    # The masks are artificial, so their IoU means nothing.
    quality = replace(fitted.quality, mask_iou_left=torch.full_like(fitted.quality.mask_iou_left, torch.nan))
    cars = replace(fitted, T_cam_obj=kept, covariance_xyz_yaw=covariance, quality=quality)
    return ShapeFit(cars, samples.counts, *distances)


def _fitter(prior: ShapePrior | None, samples: PointSamples) -> DirectShapeRefiner:
    """A refiner whose terms are the points and the priors."""
    plain = RefinerConfig(check="off", rig=RigConfig(0.0))
    # The fit uses neither images nor a detector.
    config = replace(
        plain,
        silhouette=replace(plain.silhouette, weight=0.0),
        photometric=replace(plain.photometric, weight=0.0),
        priors=replace(plain.priors, detector_weight=0.0),
    )
    of_points = PointCloudConfig(weight=_WEIGHT, min_points=_LEAST_POINTS)

    def point_term(_: FrameBatch, __: Detections, cars: CarBatch, ___: ShapePrior) -> PointCloud:
        is_kept = torch.zeros_like(samples.counts, dtype=torch.bool).index_fill(0, cars.detection_row, True)
        return PointCloud.of_points(of_points, samples.of(Chosen.where(is_kept)))

    return DirectShapeRefiner(prior, config, extra_terms=[point_term])


def _without_points_unknown(cars: RefinementResult, counts: Tensor, T_cam_obj: Tensor) -> RefinementResult:
    """Cars with too few points keep their boxes."""
    few = counts < _LEAST_POINTS
    status = torch.where(few, Status.too_few_points.code, cars.status_code)
    T = torch.where(few[:, None, None], T_cam_obj, cars.T_cam_obj)
    return replace(cars, status_code=status, T_cam_obj=T, code=cars.code.masked_fill(few[:, None], 0.0))


def _points_of_boxes(
    points: Tensor, T_points_obj: Tensor, T_cam_obj: Tensor, hwl: Tensor
) -> tuple[PointSamples, Tensor]:
    """The points in each box in camera coordinates of its car, and the transforms (N, 4, 4) to these coordinates."""
    T_cam_points = T_cam_obj @ se3.inverse(T_points_obj)
    height, width, length = (hwl + hwl.new_tensor([_BEYOND_BOX_M, 2 * _BEYOND_BOX_M, 2 * _BEYOND_BOX_M])).T
    car, chosen, counts = [], [], []
    for number in range(len(hwl)):
        x, y, z = se3.transform(se3.inverse(T_points_obj[number]), points).T
        inside = (x.abs() < length[number] / 2) & (z.abs() < width[number] / 2)
        inside &= (-y < height[number]) & (-y > _LEAST_HEIGHT_M)
        (rows,) = inside.nonzero(as_tuple=True)
        counts.append(len(rows))
        rows = rows[:: max(1, math.ceil(len(rows) / _MOST_POINTS))]
        car.append(torch.full_like(rows, number))
        chosen.append(se3.transform(T_cam_points[number], points[rows]))
    none = torch.zeros(0, dtype=torch.long, device=points.device)
    samples = PointSamples(
        torch.cat([none, *car]),
        torch.cat([points[:0], *chosen]),
        torch.tensor(counts, dtype=torch.long, device=points.device),
    )
    return samples, T_cam_points


def _scene(hwl: Tensor) -> tuple[FrameBatch, Detections]:
    """Black images and detections of the cars in front of a virtual camera."""
    K = torch.tensor([[32.0, 0.0, 16.0], [0.0, 32.0, 16.0], [0.0, 0.0, 1.0]]).to(hwl)
    black = torch.zeros(3, 32, 32).to(hwl)
    frames = FrameBatch.from_images(black, black, StereoCamera.from_intrinsics(K, 0.5), _CAMERA_HEIGHT_M)
    # Cars are turned by 45 degrees to avoid degenerate views.
    place = hwl.new_tensor([0.0, _CAMERA_HEIGHT_M, _DISTANCE_M, math.pi / 4]).expand(len(hwl), 4)
    boxes = torch.cat([place[:, :3], hwl, place[:, 3:]], dim=1)
    # Masks cover the whole image, because the refiner skips cars without a mask.
    everything = torch.ones(len(hwl), 32, 32, dtype=torch.bool, device=hwl.device)
    return frames, Detections.from_boxes(boxes, "kitti", mask_left=everything)


def _distances(samples: PointSamples, cars: RefinementResult) -> Tensor:
    """Mean distance (N,) of the points of each car to its surface, metres."""
    bound = cars.prior.bind(cars.code)
    owner = samples.object_index
    points_obj = se3.transform(se3.inverse(cars.T_cam_obj)[owner], samples.points_cam)
    distance = bound.value(points_obj, owner).abs().double()
    sums = torch.zeros(len(cars), dtype=torch.float64, device=distance.device).index_add(0, owner, distance)
    number = torch.bincount(owner, minlength=len(cars))
    return torch.where(number > 0, sums / number.clamp_min(1), torch.nan)
