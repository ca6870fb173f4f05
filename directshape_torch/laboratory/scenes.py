"""This module gives the laboratory real images: the bundled frame, and cars placed into it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from directshape_torch.geometry import se3
from directshape_torch.geometry.box3d import box_corners
from directshape_torch.geometry.projection import project, rays_from_pixels, right_rays
from directshape_torch.io.stereo_dataset import open_dataset
from directshape_torch.rows import Rays, Rows
from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import FrameBatch
from directshape_torch.scene.masks import MaskCrops
from directshape_torch.shape.field import field_of
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.terms.depth import march

DEMO_FOLDER = Path(__file__).parents[1] / "assets" / "demo"

_MASK_SAMPLES_PER_RAY = 24
# Masks of near cars are drawn on a coarser lattice, because the laboratory only needs a plausible contour.
_MASK_ROWS = 30


@dataclass(frozen=True)
class LaboratoryScene:
    """This is one frame with its detections, float64."""

    frame: FrameBatch
    detections: Detections


def load_scene() -> LaboratoryScene:
    """The bundled demo frame with its detections that have masks in both images.

    Examples:
        >>> load_scene().detections.T_cam_obj.dtype
        torch.float64
    """
    detections = DEMO_FOLDER / "detections" / "noisy_stereo"
    dataset = open_dataset("kitti", DEMO_FOLDER, detections, DEMO_FOLDER / "training" / "masks", dtype=torch.float64)
    loaded = dataset.load(dataset.frame_ids[0])
    has_both = loaded.detections.has_mask_left & loaded.detections.has_mask_right
    return LaboratoryScene(loaded.frame, loaded.detections.rows(has_both.nonzero()[:, 0]))


def place_cars(
    scene: LaboratoryScene,
    prior: PCAShapePrior,
    T_cam_obj: Tensor,  # (B, 4, 4)
    code: Tensor,  # (B, K)
) -> Detections:
    """Detections of cars that are not in the picture, with their true masks over the existing image content."""
    frame = scene.frame
    count, (height, width) = len(T_cam_obj), frame.images_left.shape[2:]
    corners = box_corners(T_cam_obj, prior.dimensions_mean_hwl.expand(count, 3))
    # A car close to the camera can have corners behind the camera.
    uv = project(torch.cat([corners[..., :2], corners[..., 2:].clamp_min(0.3)], dim=-1), frame.camera.K_left[0])
    limit = uv.new_tensor([width - 1, height - 1])
    box = torch.cat([uv.amin(dim=1).clamp_min(0).minimum(limit), uv.amax(dim=1).clamp_min(0).minimum(limit)], dim=1)
    masks = {
        side: torch.stack([_mask(scene, prior, T_cam_obj[b], code[b], side, box[b]) for b in range(count)])
        for side in ("left", "right")
    }
    return Detections(
        frame_index=torch.zeros(count, dtype=torch.long),
        T_cam_obj=T_cam_obj,
        dimensions_hwl=prior.dimensions_mean_hwl.expand(count, 3).clone(),
        box_2d=box,
        score=torch.ones(count, dtype=T_cam_obj.dtype),
        mask_left=MaskCrops.of(masks["left"]),
        mask_right=MaskCrops.of(masks["right"]),
    )


def _mask(
    scene: LaboratoryScene, prior: PCAShapePrior, T_cam_obj: Tensor, code: Tensor, side: str, box_left: Tensor
) -> Tensor:
    """Silhouette (H, W) of one car, drawn on a lattice that suits its size in the image."""
    camera = scene.frame.camera
    height, width = scene.frame.images_left.shape[2:]
    focal, depth = float(camera.K_left[0, 0, 0]), float(T_cam_obj[2, 3])
    stride = max(1, round(1.6 * focal / depth / _MASK_ROWS))
    # The margin leaves room for the largest shapes, and the shift for the disparity in the right image.
    u0, v0, u1, v1 = (int(x) for x in box_left)
    margin = round(0.8 * focal / depth)
    shift = round(focal * float(camera.baseline[0]) / depth) if side == "right" else 0
    rows = torch.arange(max(0, v0 - margin), min(height, v1 + margin + 1), stride)
    columns = torch.arange(max(0, u0 - margin - shift), min(width, u1 + margin + 1), stride)
    v, u = torch.meshgrid(rows, columns, indexing="ij")
    hit = _hits(scene, prior, se3.inverse(T_cam_obj), code, side, torch.stack([u, v], dim=-1).reshape(-1, 2))
    mask = code.new_zeros(height, width)
    fine = hit.reshape(v.shape).to(code).repeat_interleave(stride, dim=0).repeat_interleave(stride, dim=1)
    if len(rows) and len(columns):
        part = mask[int(rows[0]) :, int(columns[0]) :]
        part[: fine.shape[0], : fine.shape[1]] = fine[: part.shape[0], : part.shape[1]]
    return mask


def _hits(
    scene: LaboratoryScene, prior: PCAShapePrior, T_obj_cam: Tensor, code: Tensor, side: str, uv: Tensor
) -> Tensor:
    """Whether the rays of pixels (P, 2) of one side meet the shape, (P,)."""
    camera = scene.frame.camera
    uv = uv.to(code.dtype)
    if side == "left":
        direction = rays_from_pixels(uv, camera.K_left[0])
        centre = torch.zeros_like(direction)
    else:
        centre, direction = right_rays(uv, camera.K_right[0], camera.T_right_cam[0])
    rows = Rows.of_sorted(torch.zeros(len(uv), dtype=torch.long), 1)
    rays = Rays.of_rows(rows, centre, direction).in_objects(T_obj_cam[None])
    marched = march(field_of(prior.bind(code[None])), rows.blocks.owner, rays, prior.bounds_obj, _MASK_SAMPLES_PER_RAY)
    return (marched.crosses & (marched.sdf < 0).any(dim=0)).flatten()[rows.places]
