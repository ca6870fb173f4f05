"""This module makes a term of the LiDAR points of `FrameBatch.points_cam` on each car (docs/extra_terms.md)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from directshape_torch.config import PointCloudConfig
from directshape_torch.errors import InputError
from directshape_torch.geometry.projection import project
from directshape_torch.numerics.tensors import occurrences
from directshape_torch.rows import PointSamples
from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import FrameBatch
from directshape_torch.scene.masks import MASK_THRESHOLD
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.state.cars import CarBatch
from directshape_torch.terms.car_points import every_nth, stands_at
from directshape_torch.terms.point_cloud import PointCloud

# Points further than this outside the box, more than a detector's position error, belong to something else.
_BEYOND_BOX_M = 1.0
# Points of a car have heights in this range above the ground plane, whose error is 0.05 m: lower points are road.
_HEIGHTS_M = (0.15, 3.0)
# Fewer points than this may all be of a pole or of a car behind, and would weigh as much as hundreds.
_LEAST_POINTS = 10
_MOST_POINTS = 1000


@dataclass(frozen=True)
class LidarPoints:
    """This `TermFactory` makes the term "lidar" of the points that the frames bring.

    A point gives the position of the surface to about 4 cm: 2 to 3 cm of noise of the scanner, and 2 to 3 cm by which a
    shape of a few codes in cells of 0.1 m differs from a real car. The second part is common to the points of a panel,
    so all points of a car count as one sure measurement, in the units of the priors (half a squared standard deviation,
    at weight 0.5): `0.5 / 0.04^2 = 300` per square metre. A point further away than a cell (a mirror, a seat behind
    glass) is no surface that the shape can follow, and it pulls with a constant force.

    Attributes:
        weight: of the mean over the points of a car, per square metre.
        huber_m: corner of the Huber norm.

    Examples:
        >>> LidarPoints()
        LidarPoints(weight=300.0, huber_m=0.1)
    """

    weight: float = 300.0
    huber_m: float = 0.1

    def __call__(self, frames: FrameBatch, detections: Detections, cars: CarBatch, prior: ShapePrior) -> PointCloud:
        config = PointCloudConfig(self.weight, huber_m=self.huber_m, min_points=_LEAST_POINTS, max_points=_MOST_POINTS)
        return PointCloud.of_points(config, lidar_points(frames, detections, cars.detection_row), "lidar")


def lidar_points(frames: FrameBatch, detections: Detections, rows: Tensor) -> PointSamples:
    """Return the points of the detections in `rows` (B,).

    A point belongs to a car if it falls into the left mask (the 2D box where there is no mask), is above the ground,
    and is no further from the middle of the box along the ground than half the box's diagonal plus a detector's error.

    Raises:
        InputError: the frames bring no points.
    """
    if frames.points_cam is None:
        cure = "FrameBatch(points_cam=...), or refine --lidar DIR"
        raise InputError("frames.points_cam", "LiDAR points of each frame", "None", cure)
    frame = detections.frame_index[rows]
    points = frames.points_cam.detach()[frame]
    reach = 0.5 * detections.dimensions_hwl[rows, 1:].norm(dim=-1, keepdim=True) + _BEYOND_BOX_M
    belongs = _in_mask(frames, detections, rows, points)
    belongs = belongs & stands_at(frames, detections, rows[:, None], points, reach, _HEIGHTS_M)
    car, number = belongs.nonzero(as_tuple=True)
    counts = occurrences(car, len(rows))
    kept = every_nth(car, counts, _MOST_POINTS)
    return PointSamples(car[kept], frames.points_cam[frame[car[kept]], number[kept]], counts)


def _in_mask(frames: FrameBatch, detections: Detections, rows: Tensor, points_cam: Tensor) -> Tensor:
    """Mask (B, P) of points that the left camera sees in the mask, or 2D box, of their car; false for NaN."""
    frame = detections.frame_index[rows]
    uv = project(points_cam, frames.camera.K_left[frame][:, None])
    height, width = frames.sizes[frame, :, None].unbind(1)
    column, row = uv.nan_to_num(-1.0).round().clamp(-1, max(frames.images_left.shape[2:])).long().unbind(-1)
    seen = (points_cam[..., 2] > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    column, row = (torch.where(seen, x, torch.zeros_like(x)) for x in (column, row))
    masked = detections.mask_left.at(rows[:, None], column, row) > MASK_THRESHOLD
    u_min, v_min, u_max, v_max = detections.box_2d[rows, :, None].unbind(1)
    u, v = uv.unbind(-1)
    in_box = (u >= u_min) & (u <= u_max) & (v >= v_min) & (v <= v_max)
    return seen & torch.where(detections.has_mask_left[rows, None], masked, in_box)
