"""This module has numbers that are inexact in fewer digits, and public functions of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import torch
from helpers.ellipsoids import ellipsoid_prior
from helpers.synthetic_scene import cached_street
from torch import Tensor

from directshape_torch import (
    Detections,
    DirectShapeRefiner,
    DisparityField,
    FrameBatch,
    GroundPlane,
    PCAShapePrior,
    RefinementResult,
    RigEstimate,
    StereoCamera,
    check_scene,
    fit_shape,
    load_config,
)
from directshape_torch.evaluation import pose_error, rotated_iou
from directshape_torch.geometry import box3d, box_formats, disparity_field, image_boxes, projection, se3, stereo_depth
from directshape_torch.shape import pca_fit, zero_level
from directshape_torch.shape.neural_prior import NeuralShapePrior
from directshape_torch.shape.prior_file import PriorProvenance


@dataclass(frozen=True)
class Numbers:
    """A `Numbers` has tensors of one dtype in which no product is exact in fewer digits than float32 has."""

    uv: Tensor  # (20, 2) pixels
    depth: Tensor  # (20,) metres
    points: Tensor  # (20, 3) metres, in the camera frame
    near: Tensor  # (20, 3) metres, in the object frame
    twist: Tensor  # (2, 6)
    T: Tensor  # (2, 4, 4)
    T_cam_lidar: Tensor  # (4, 4), turned by right angles
    K: Tensor  # (3, 3)
    T_right_cam: Tensor  # (4, 4)
    P_left: Tensor  # (1, 3, 4)
    P_right: Tensor  # (1, 3, 4)
    boxes: Tensor  # (2, 7)
    boxes_beside: Tensor  # (2, 7), partly in the same place
    hwl: Tensor  # (2, 3)
    code: Tensor  # (2, 3)
    images: Tensor  # (1, 3, 120, 160)

    def to(self, dtype: torch.dtype) -> Numbers:
        return Numbers(**{name: value.to(dtype) for name, value in vars(self).items()})


@cache
def numbers() -> Numbers:
    """Numbers of float32."""
    chance = torch.Generator().manual_seed(0)

    def between(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(shape, generator=chance)

    K = torch.tensor([[721.5377, 0.0, 609.5593], [0.0, 721.5377, 172.854], [0.0, 0.0, 1.0]])
    T_right_cam, T_cam_lidar = torch.eye(4), torch.zeros(4, 4)
    T_right_cam[:3, 3] = torch.tensor([-0.5327, 0.0027, 0.0031])
    T_cam_lidar[0, 1] = T_cam_lidar[1, 2] = -1
    T_cam_lidar[2, 0] = T_cam_lidar[3, 3] = 1
    T_cam_lidar[:3, 3] = torch.tensor([0.0613, -0.0871, -0.2713])
    points = torch.stack([between(-9, 9, 20), between(-1, 2, 20), between(7, 40, 20)], dim=1)
    twist = between(-1, 1, 2, 6)
    boxes = torch.stack([points[0], points[1]])
    sizes = torch.tensor([[1.523, 1.617, 4.013, 0.317], [1.481, 1.703, 4.391, -1.217]])
    boxes = torch.cat([boxes, sizes], dim=1)
    P_left, P_right = (
        torch.cat([K, torch.tensor(x)], dim=1)[None]
        for x in ([[44.857], [0.216], [0.003]], [[-339.524], [2.199], [0.003]])
    )
    return Numbers(
        uv=between(3, 157, 20, 2),
        depth=between(7, 40, 20),
        points=points,
        near=between(-1.2, 1.2, 20, 3),
        twist=twist,
        T=se3.exp(twist.double()).float(),
        T_cam_lidar=T_cam_lidar,
        K=K,
        T_right_cam=T_right_cam,
        P_left=P_left,
        P_right=P_right,
        boxes=boxes,
        boxes_beside=boxes + 0.31,
        hwl=sizes[:, :3],
        code=between(-2, 2, 2, 3),
        images=between(0, 1, 1, 3, 120, 160),
    )


def rig(n: Numbers) -> tuple[Tensor, Tensor, Tensor]:
    return n.K, n.K, n.T_right_cam


def field(n: Numbers) -> DisparityField:
    made = DisparityField.constant(-0.4173, (160, 120), *rig(n))
    some = 0.1 * torch.sin(torch.arange(100, dtype=torch.float64)).view(10, 10)
    parts = some[0], some[1], some @ some.mT
    names = ("coefficients", "vertical_coefficients", "covariance")
    return replace(made, **{name: part.float() for name, part in zip(names, parts, strict=True)})


def camera(n: Numbers) -> StereoCamera:
    return StereoCamera.from_intrinsics(n.K, 0.5327, disparity_field=field(n))


def camera_parts(made: StereoCamera) -> list[Tensor]:
    return [made.K_left, made.K_right, made.T_right_cam, made.t_cam_ref]


def of_kornia() -> StereoCamera:
    from kornia.geometry.camera import PinholeCamera

    eye = torch.eye(4, dtype=torch.float32)[None]
    wide, size = eye.clone(), torch.tensor([120])
    wide[0, :3, :3] = numbers().K
    left, right = eye, numbers().T_right_cam[None]
    return StereoCamera.from_kornia(PinholeCamera(wide, left, size, size), PinholeCamera(wide, right, size, size))


def detections(n: Numbers) -> Detections:
    mask = torch.zeros(2, 120, 160, dtype=torch.bool)
    mask[:, 40:80, 30:90] = True
    return Detections.from_boxes(
        n.boxes,
        "mmdet3d_lidar",
        mask_left=mask,
        T_cam_boxes=n.T_cam_lidar,
        score=n.depth[:2],
        pose_sigma=n.twist[:, :4].abs(),
    )


def frames(n: Numbers) -> FrameBatch:
    return FrameBatch.from_images(n.images, n.images, StereoCamera.from_intrinsics(n.K, 0.5327), 1.6573)


def tensors(record: Any) -> list[Tensor]:
    return [each.value for each in record.tensors("")]


@cache
def grids() -> PCAShapePrior:
    return ellipsoid_prior(torch.float32)


@cache
def network() -> NeuralShapePrior:
    torch.manual_seed(0)
    made = PriorProvenance("a test", "Apache-2.0", 8)
    prior = NeuralShapePrior([16, 16], 3, torch.tensor([-2.8, -2.2, -1.6]), (8, 8, 8), 0.7, made)
    prior.dimensions_linear_hwl.normal_()
    prior.dimensions_quadratic_hwl.normal_()
    return prior


FOOTPRINT = [0, 2, 5, 4, 6]
OWNERS = torch.arange(20) % 2
Prior = PCAShapePrior | NeuralShapePrior


def of_prior(name: str, shape: str, make: Callable[[], Prior]) -> dict[str, Case]:
    """The public functions of a family of shapes."""
    return {
        f"{name}.values": lambda n: make().values(n.code),
        f"{name}.dimensions_and_derivative": lambda n: make().dimensions_and_derivative(n.code),
        f"{shape}.value": lambda n: make().bind(n.code).value(n.near, OWNERS),
        f"{shape}.value_and_derivatives": lambda n: make().bind(n.code).value_and_derivatives(n.near, OWNERS),
    }


@cache
def street() -> tuple[FrameBatch, Detections]:
    _, made = cached_street()
    return made.frames.to(torch.float32), made.detections.to(torch.float32)


@cache
def refiner() -> DirectShapeRefiner:
    quick = ["stages=[{contour_width_px: 0.5, image_level: 0, max_iterations: 2}]", "check=off"]
    return DirectShapeRefiner(grids(), load_config(None, quick))


@cache
def result() -> RefinementResult:
    with torch.no_grad():
        found: RefinementResult = refiner()(*street())
    return found


def read_back() -> RefinementResult:
    return RefinementResult.from_state_dict(result().state_dict(), grids())


def estimate() -> RigEstimate:
    made = RigEstimate.of_frames(street()[0])
    made.update(*street())
    return made


def with_rows(rows: Tensor) -> RigEstimate:
    made = RigEstimate.of_frames(street()[0])
    made.add_rows(rows)
    return made


def learnt() -> RigEstimate:
    made = estimate()
    with torch.no_grad():
        made.learn(street()[0], DirectShapeRefiner(grids(), refiner().config, rig=made)(*street()))
    return made


def fitted(n: Numbers) -> list[Tensor]:
    chance = torch.Generator().manual_seed(2)
    points = numbers().boxes[:1, :3] + 1.5 * (torch.rand(200, 3, generator=chance, dtype=torch.float32) - 0.5)
    fit = fit_shape(points, n.boxes[:1], "opencv", grids())
    return [fit.cars.T_cam_obj, fit.cars.code, fit.distance_before_m, fit.distance_after_m, fit.cars.covariance_xyz_yaw]


def samples() -> Tensor:
    return grids().values(torch.eye(4, 3, dtype=torch.float32))


def started(n: Numbers) -> Detections:
    """The start of a car whose back is 12 m ahead, on a hill, because these images lie above the horizon."""
    given = frames(n)
    disparity = torch.full_like(given.images_left[:, 0], 0.5327 * float(given.camera.K_left[0, 0, 0]) / 12.0)
    ground = GroundPlane(given.ground.normal, torch.full_like(given.ground.offset, -1.25), given.ground.source)
    mask = torch.zeros(1, *given.images_left.shape[2:], dtype=torch.bool)
    mask[0, 5:95, 20:118] = True
    return Detections.from_masks(replace(given, disparity=disparity, ground=ground), mask, score=n.depth[:1])


Case = Callable[[Numbers], Any]
# What a `Numbers` gives that is compared: tensors, arrays, or records and tuples of them.
CASES: dict[str, Case] = {
    "se3.exp": lambda n: se3.exp(n.twist),
    "se3.inverse": lambda n: se3.inverse(n.T),
    "se3.transform": lambda n: se3.transform(n.T[0], n.points),
    "se3.from_rotation_translation": lambda n: se3.from_rotation_translation(n.T[:, :3, :3], n.points[:2]),
    "se3.to_kornia": lambda n: se3.to_kornia(n.T).matrix(),
    "se3.from_kornia": lambda n: se3.from_kornia(se3.to_kornia(n.T)),
    "projection.rays_from_pixels": lambda n: projection.rays_from_pixels(n.uv, n.K),
    "projection.project": lambda n: projection.project(n.points, n.K),
    "stereo_depth.warp_to_right": lambda n: stereo_depth.warp_to_right(n.points, n.depth, n.K, n.T_right_cam, n.depth),
    "projection.right_rays": lambda n: projection.right_rays(n.uv, n.K, n.T_right_cam, n.depth, n.depth),
    "stereo_depth.disparity_of_depth": lambda n: stereo_depth.disparity_of_depth(n.uv, n.depth, *rig(n)),
    "stereo_depth.depth_from_disparity": lambda n: stereo_depth.depth_from_disparity(n.uv, n.depth, *rig(n), field(n)),
    "stereo_depth.points_from_disparity": lambda n: stereo_depth.points_from_disparity(n.uv, n.depth, *rig(n)),
    "box3d.pose_from_kitti": lambda n: box3d.pose_from_kitti(n.points, n.depth),
    "box3d.rotation_y_from_pose": lambda n: box3d.rotation_y_from_pose(n.T),
    "box3d.viewing_axes": lambda n: box3d.viewing_axes(n.points),
    "box3d.box_corners": lambda n: box3d.box_corners(n.T, n.hwl),
    "box_formats.boxes_to_poses": lambda n: [
        *box_formats.boxes_to_poses(n.boxes, "kitti"),
        *box_formats.boxes_to_poses(n.boxes, "nuscenes", n.T_cam_lidar),
        *box_formats.boxes_to_poses(box3d.box_corners(*box_formats.boxes_to_poses(n.boxes, "kitti")), "kitti"),
    ],
    "box_formats.poses_to_boxes": lambda n: [
        box_formats.poses_to_boxes(n.T, n.hwl, "opencv"),
        box_formats.poses_to_boxes(n.T, n.hwl, "nuscenes", n.T_cam_lidar),
    ],
    "image_boxes.box_outlines": lambda n: [*image_boxes.box_outlines(n.T, n.hwl, camera(n))],
    "image_boxes.project_boxes": lambda n: image_boxes.project_boxes(n.T, n.hwl, camera(n), (120, 160)),
    "disparity_field.nearest_in_convex_polygon": lambda n: disparity_field.nearest_in_convex_polygon(
        n.uv, torch.tensor([[10.0, 10.0], [50.0, 20.0], [30.0, 70.0]]).to(n.uv)
    ),
    "DisparityField.constant": lambda n: DisparityField.constant(-0.4173, (160, 120), *rig(n)).bias(n.uv),
    "DisparityField.offsets": lambda n: field(n).offsets(n.uv),
    "DisparityField.sigma": lambda n: field(n).sigma(n.uv),
    "StereoCamera.from_intrinsics": lambda n: camera_parts(StereoCamera.from_intrinsics(n.K, n.depth[0], n.K)),
    "StereoCamera.from_projections": lambda n: camera_parts(StereoCamera.from_projections(n.P_left, n.P_right)),
    "StereoCamera.from_kornia": lambda _: camera_parts(of_kornia()),
    "StereoCamera.field_sigma_px": lambda n: camera(n).field_sigma_px(torch.zeros(20, dtype=torch.long), n.points),
    "FrameBatch.from_images": lambda n: tensors(frames(n)),
    "Detections.from_boxes": lambda n: tensors(detections(n)),
    "Detections.from_masks": lambda n: tensors(started(n)),
    **of_prior("PCAShapePrior", "GridShape", grids),
    **of_prior("NeuralShapePrior", "NeuralShape", network),
    "pca_fit.fit_pca": lambda _: [*pca_fit.fit_pca(samples(), grids().origin, 0.2, 2, grids().provenance).buffers()],
    "pca_fit.fit_car": lambda _: pca_fit.fit_car(grids(), samples()[1]),
    "zero_level.zero_level_extents": lambda _: zero_level.zero_level_extents(samples(), grids().origin, 0.2),
    "zero_level.sdf_to_mesh": lambda n: zero_level.sdf_to_mesh(samples()[0], grids().origin, 0.2, n.T[0]).vertices,
    "rotated_iou.bev_iou": lambda n: rotated_iou.bev_iou(n.boxes[:, FOOTPRINT], n.boxes_beside[:, FOOTPRINT]),
    "rotated_iou.iou_3d": lambda n: rotated_iou.iou_3d(n.boxes, n.boxes_beside),
    "pose_error.pose_errors": lambda n: pose_error.pose_errors(n.boxes, n.boxes_beside),
    "fit_shape.fit_shape": fitted,
    "check_scene.check_scene": lambda _: str(check_scene(*street(), match_images=False)),
    "DirectShapeRefiner.forward": lambda _: refiner()(*street()).state_dict(),
    "DirectShapeRefiner.problem": lambda _: [*refiner().problem(*street())[1]],
    "RefinementResult.boxes": lambda _: vars(result().boxes()),
    "RefinementResult.to_boxes": lambda n: result().to_boxes("nuscenes", T_cam_boxes=n.T_cam_lidar),
    "RefinementResult.corners": lambda _: result().corners(),
    "RefinementResult.T_ref_obj": lambda _: result().T_ref_obj,
    "RefinementResult.mesh": lambda _: result().mesh(0).vertices,
    "RefinementResult.from_state_dict": lambda _: read_back().state_dict(),
    "DisparityProfile.after": lambda _: result().profile.after,
    "RigEstimate.of_frames": lambda _: estimate().mean,
    "RigEstimate.update": lambda _: estimate().rows,
    "RigEstimate.offset_at": lambda n: estimate().offset_at(n.uv),
    "RigEstimate.corrected": lambda n: estimate().corrected(street()[0]).camera.disparity_field.bias(n.uv),
    "RigEstimate.informed": lambda _: tensors(estimate().informed(estimate().corrected(street()[0]), street()[1])),
    "RigEstimate.add_rows": lambda _: with_rows(torch.full((1, 8), 7.3, dtype=torch.float32)).mean,
    "RigEstimate.learn": lambda _: learnt().results,
    "RigEstimate.detector_sigmas": lambda _: learnt().detector_sigmas(),
    "RigEstimate.along_the_width": lambda _: estimate().along_the_width(),
}  # fmt: skip
