"""This module selects the stereo points of each car, which a point cloud term fits (Engelmann et al., GCPR 2016)."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from directshape_torch.config import PointCloudConfig
from directshape_torch.errors import InputError
from directshape_torch.geometry.stereo_depth import points_from_disparity
from directshape_torch.numerics.tensors import occurrences
from directshape_torch.rows import PointSamples
from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import FrameBatch
from directshape_torch.scene.masks import MASK_THRESHOLD

# About this many pixels are processed at once; each takes about 200 bytes.
_MOST_PIXELS = 2**20
# Points of a car have a height above the ground plane in this range: lower points are road, higher ones are trees.
_HEIGHTS_M = (0.1, 3.0)
# Points of a car are this close to the detection's centre along the ground: half a long car plus a detector's error.
_REACH_M = 2.5


def car_points(frames: FrameBatch, detections: Detections, config: PointCloudConfig) -> PointSamples:
    """Return the points of the left pixels of every car, without the rig's bias, filtered by height and distance.

    Args:
        frames: F frames with disparity.
        detections: B cars with finite or NaN poses; a car without a pose has no points.
        config: largest number of points of a car.

    Returns:
        The points, differentiable by the disparity.

    Raises:
        InputError: the frames have no disparity.
    """
    disparity = frames.disparity
    if disparity is None:
        raise InputError("frames.disparity", "a disparity map of each frame", "None", "use with_disparity")
    parts = [_points(frames, detections, disparity, pixels) for pixels in _pixels(frames, detections)]
    object_index, points_cam = (torch.cat(columns) for columns in zip(*parts, strict=True))
    counts = occurrences(object_index, len(detections))
    kept = every_nth(object_index, counts, config.max_points)
    return PointSamples(object_index[kept], points_cam[kept], counts)


def _points(
    frames: FrameBatch, detections: Detections, disparity: Tensor, pixels: Tensor
) -> tuple[Tensor, Tensor]:  # (P,), (P, 3)
    """The points at pixels (3, P) that may belong to their car: the numbers of the cars and the positions."""
    object_index, v, u = pixels
    measured = disparity[detections.frame_index[object_index], v, u]
    # Where nothing is measured it is NaN, infinite, zero or negative.
    known = (measured.isfinite() & (measured > 0)).nonzero()[:, 0]
    object_index, v, u = object_index[known], v[known], u[known]
    frame = detections.frame_index[object_index]
    camera = frames.camera
    points_cam = points_from_disparity(
        torch.stack([u, v], dim=-1).to(disparity),
        disparity[frame, v, u],
        camera.K_left[frame],
        camera.K_right[frame],
        camera.T_right_cam[frame],
        camera.disparity_field,
    )
    passes = stands_at(frames, detections, object_index, points_cam.detach(), _REACH_M, _HEIGHTS_M)
    passed = passes.nonzero()[:, 0]
    return object_index[passed], points_cam[passed]


def _pixels(frames: FrameBatch, d: Detections) -> Iterator[Tensor]:
    """Yield the left pixels of each car, from its mask if it has one, else from its 2D box: car, row and column (3, P).

    The pixels come in parts that bound the memory, because thousands of boxes cover an image many times.
    """
    has_mask, crops, sizes = d.has_mask_left.tolist(), d.mask_left.boxes.tolist(), frames.sizes[d.frame_index].tolist()
    boxes = d.box_2d.detach().double().cpu()
    corners = torch.cat([boxes[:, :2].ceil(), boxes[:, 2:].floor() + 1], dim=1).clamp(min=0)
    corners[boxes.isnan().any(dim=1)] = 0
    part, num_pixels = [d.frame_index.new_zeros(3, 0)], 0
    for car, (height, width) in enumerate(sizes):
        # Pixels in the padding of a smaller frame do not count.
        if has_mask[car]:
            u0, v0 = crops[car][:2]
            pixels = d.mask_left.crop(car)[: max(0, height - v0), : max(0, width - u0)] > MASK_THRESHOLD
        else:
            limit = boxes.new_tensor([width, height, width, height])
            u0, v0, u1, v1 = corners[car].minimum(limit).long().tolist()
            pixels = d.frame_index.new_ones(max(0, v1 - v0), max(0, u1 - u0))
        v, u = pixels.nonzero().unbind(1)
        part.append(torch.stack([torch.full_like(v, car), v + v0, u + u0]))
        num_pixels += len(v)
        if num_pixels > _MOST_PIXELS:
            yield torch.cat(part, dim=1)
            part, num_pixels = part[:1], 0
    yield torch.cat(part, dim=1)


def stands_at(
    frames: FrameBatch,
    detections: Detections,
    car: Tensor,  # (*,) car of each point, or a shape that broadcasts to it
    points_cam: Tensor,  # (*, 3)
    reach_m: Tensor | float,  # largest distance from the detection's centre, along the ground
    heights_m: tuple[float, float],
) -> Tensor:
    """Mask (*,) of the points that are above the ground and near their car; NaN fails every comparison."""
    frame = detections.frame_index[car]
    normal = frames.ground.normal[frame]
    height = (normal * points_cam).sum(-1) + frames.ground.offset[frame]
    offset = points_cam - detections.T_cam_obj[car, :3, 3]
    along_ground = offset - (offset * normal).sum(-1, keepdim=True) * normal
    near: Tensor = along_ground.norm(dim=-1) <= reach_m
    return near & (height >= heights_m[0]) & (height <= heights_m[1])


def every_nth(object_index: Tensor, counts: Tensor, most: int) -> Tensor:
    """Row numbers of at most `most` points of each object, evenly spread over its pixels in row-major order."""
    first = torch.cumsum(counts, 0) - counts
    place = torch.arange(len(object_index), device=counts.device) - first[object_index]
    stride = (counts + most - 1) // most
    return (place % stride.clamp_min(1)[object_index] == 0).nonzero()[:, 0]
