"""This module renders a tiny stereo street with exact truth: textured shapes over a textured ground, ray cast."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import torch
from reference.rays import RaysObj, first_entry
from torch import Tensor

from directshape_torch.geometry import se3
from directshape_torch.geometry.box3d import box_corners, pose_from_kitti
from directshape_torch.geometry.ground_plane import GroundPlane
from directshape_torch.geometry.projection import project, rays_from_pixels, right_rays
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.geometry.stereo_depth import disparity_of_depth
from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import FrameBatch
from directshape_torch.shape.pca_prior import PCAShapePrior

CAMERA_HEIGHT_M = 1.65
BACKDROP_M = 150.0


@dataclass(frozen=True)
class Street:
    """A `Street` has frames, perfect detections and the truth from which they were rendered."""

    frames: FrameBatch
    detections: Detections
    code: Tensor  # (B, K)
    disparity: Tensor  # (1, H, W) pixels, exact to rounding; NaN where no car is


def stereo_camera(width: int, height: int, focal_px: float, dtype: torch.dtype = torch.float64) -> StereoCamera:
    """A rig with KITTI's baseline whose right camera is also a little lower and further back."""
    K = torch.tensor([[focal_px, 0, width / 2 - 3], [0, focal_px, height / 2 - 10], [0, 0, 1]], dtype=dtype)[None]
    T_right_cam = torch.eye(4, dtype=dtype)[None].clone()
    T_right_cam[0, :3, 3] = torch.tensor([-0.53, -0.003, 0.004], dtype=dtype)
    t_cam_ref = torch.tensor([[0.06, -0.001, 0.003]], dtype=dtype)
    return StereoCamera(K, K.clone(), T_right_cam, t_cam_ref)


def _texture(points: Tensor, phase: float) -> Tensor:
    """Smooth grey pattern (*,) in [0, 1] with structure at several scales."""
    x, y, z = points.unbind(-1)
    waves = torch.sin(7.1 * x + 2.3 * y - 5.2 * z + phase) + torch.sin(-4.7 * x + 9.4 * y + 6.3 * z + 2 * phase)
    waves = waves + torch.sin(13.0 * x + 8.0 * z - 3.0 * y + 0.5 * phase) + torch.sin(2.0 * (x - z) + phase)
    return (0.5 + 0.11 * waves).clamp(0, 1)


def _render_side(
    prior: PCAShapePrior, T_cam_obj: Tensor, code: Tensor, origin_cam: Tensor, ray_cam: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Grey values (P,), depth (P,) and the number of the visible car (P,), -1 for none, of the rays of one camera."""
    ground = (CAMERA_HEIGHT_M - origin_cam[:, 1]) / ray_cam[:, 1].clamp_min(1e-6)
    depth = torch.where(ray_cam[:, 1] > 1e-3, ground, torch.full_like(ground, BACKDROP_M)).clamp_max(BACKDROP_M)
    grey = 0.35 + 0.3 * _texture((origin_cam + depth[:, None] * ray_cam) * 0.4, 0.3)
    visible = torch.full(depth.shape, -1)
    shape = prior.bind(code)
    for i in range(len(code)):
        rays = RaysObj.of(se3.inverse(T_cam_obj), torch.full(depth.shape, i), origin_cam, ray_cam)
        of_car, found = first_entry(rays, shape, prior.bounds_obj)
        nearer = found & (of_car < depth)
        depth = torch.where(nearer, of_car, depth)
        point_obj = rays.centre + of_car[:, None] * rays.direction
        grey = torch.where(nearer, _texture(0.5 * point_obj, 1.7 + i), grey)
        visible = torch.where(nearer, torch.full_like(visible, i), visible)
    return grey, depth, visible


def street(
    prior: PCAShapePrior,
    location_cam: list[tuple[float, float, float]],
    rotation_y: list[float],
    code: Tensor | None = None,
    size_wh: tuple[int, int] = (160, 120),
    focal_px: float = 150.0,
    T_right_cam: Tensor | None = None,
) -> Street:
    """One frame with the given cars, in the dtype of the prior."""
    dtype, count = prior.origin.dtype, len(location_cam)
    code = prior.initial_code(count) if code is None else code
    width, height = size_wh
    camera = stereo_camera(width, height, focal_px, dtype)
    if T_right_cam is not None:
        camera = replace(camera, T_right_cam=T_right_cam[None])
    location = torch.tensor(location_cam, dtype=dtype).reshape(-1, 3)
    T_cam_obj = pose_from_kitti(location, torch.tensor(rotation_y, dtype=dtype))
    v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    uv = torch.stack([u, v], dim=-1).reshape(-1, 2).to(dtype)
    left = rays_from_pixels(uv, camera.K_left)
    right = right_rays(uv, camera.K_right, camera.T_right_cam)
    images, masks, depths = [], [], []
    for origin, ray in ((torch.zeros_like(left), left), (right.origin_cam, right.direction_cam)):
        grey, depth, visible = _render_side(prior, T_cam_obj, code, origin, ray)
        depths.append(torch.where(visible >= 0, depth, torch.nan))
        images.append(grey.view(1, 1, height, width).expand(1, 3, height, width).contiguous())
        cars = torch.arange(count)[:, None]
        masks.append((visible[None] == cars).to(dtype).view(count, height, width))
    ground = GroundPlane(
        torch.tensor([[0.0, -1.0, 0.0]], dtype=dtype), torch.tensor([CAMERA_HEIGHT_M], dtype=dtype), ("file",)
    )
    frames = FrameBatch(images[0], images[1], torch.tensor([[height, width]]), camera, ground, ("000000",))
    dimensions = prior.dimensions_and_derivative(code).hwl
    corners = project(box_corners(T_cam_obj, dimensions), camera.K_left[:, None])
    last = torch.tensor([width - 1.0, height - 1.0], dtype=dtype)
    low, high = corners.amin(1).clamp_min(0).minimum(last), corners.amax(1).clamp_min(0).minimum(last)
    detections = Detections(
        frame_index=torch.zeros(count, dtype=torch.long),
        T_cam_obj=T_cam_obj,
        dimensions_hwl=dimensions,
        box_2d=torch.cat([low, high], dim=1),
        score=torch.ones(count, dtype=dtype),
        mask_left=masks[0],
        mask_right=masks[1],
    )
    rig = camera.K_left[0], camera.K_right[0], camera.T_right_cam[0]
    disparity = disparity_of_depth(uv, depths[0], *rig)[:, 0].view(1, height, width)
    return Street(frames, detections, code, disparity)


TWO_CARS = ([(-1.3, CAMERA_HEIGHT_M, 8.0), (1.9, CAMERA_HEIGHT_M, 12.5)], [0.5, -1.2])


def two_car_street(prior: PCAShapePrior) -> Street:
    """Cars at 8 and 12.5 m whose codes are not the mean's."""
    code = torch.tensor([[0.8, -0.5, 0.6], [-0.7, 0.4, 0.5]], dtype=prior.origin.dtype)[:, : prior.num_codes]
    return street(prior, *TWO_CARS, code=code)


def disturbed(detections: Detections, metres: float = 0.15, radians: float = 0.05, seed: int = 3) -> Detections:
    """The detections with seeded errors of position in the ground plane and of heading."""
    generator = torch.Generator().manual_seed(seed)
    count, dtype = len(detections), detections.T_cam_obj.dtype
    noise = torch.randn(count, 6, generator=generator, dtype=torch.float64).to(dtype)
    noise = noise * torch.tensor([metres, 0.0, metres, 0.0, radians, 0.0], dtype=dtype)
    return replace(detections, T_cam_obj=detections.T_cam_obj @ se3.exp(noise))


def masked(detections: Detections, left: Tensor | None = None, right: Tensor | None = None) -> Detections:
    """The detections with masks only where a condition (B,) is true."""
    masks_left, masks_right = detections.mask_left, detections.mask_right
    return replace(
        detections,
        mask_left=masks_left if left is None else masks_left.where(left),
        mask_right=masks_right if right is None else masks_right.where(right),
    )


def select(detections: Detections, rows: Tensor) -> Detections:
    """The detections of the given rows, in their order."""
    return detections.rows(rows)


def joined_frames(parts: list[FrameBatch]) -> FrameBatch:
    """Several frames as one batch, padded at the right and bottom with a value that must not matter."""
    height, width = (max(part.images_left.shape[i] for part in parts) for i in (2, 3))

    def padded(part: FrameBatch) -> FrameBatch:
        room = (0, width - part.images_left.shape[3], 0, height - part.images_left.shape[2])
        images = {name: getattr(part, name) for name in ("images_left", "images_right")}
        return replace(part, **{n: torch.nn.functional.pad(image, room, value=0.77) for n, image in images.items()})

    return FrameBatch.joined([padded(part) for part in parts])


def joined_detections(parts: list[Detections], size_hw: tuple[int, int]) -> Detections:
    """Detections of consecutive single-frame batches, numbered by frame, with masks padded to one size."""

    def padded(number: int, part: Detections) -> Detections:
        masks = {name: getattr(part, name).padded(size_hw) for name in ("mask_left", "mask_right")}
        return replace(part, frame_index=torch.full_like(part.frame_index, number), **masks)

    return Detections.joined([padded(number, part) for number, part in enumerate(parts)])


@lru_cache(maxsize=4)
def cached_street(dtype: torch.dtype = torch.float64) -> tuple[PCAShapePrior, Street]:
    """The two-car street, rendered once for all tests; its tensors must not be changed."""
    from helpers.ellipsoids import ellipsoid_prior

    prior = ellipsoid_prior(dtype)
    return prior, two_car_street(prior)


@lru_cache(maxsize=2)
def measured_street(dtype: torch.dtype = torch.float64) -> tuple[PCAShapePrior, Street]:
    """The two-car street with frames that have their exact disparity."""
    prior, scene = cached_street(dtype)
    return prior, replace(scene, frames=replace(scene.frames, disparity=scene.disparity))
