"""True depth from 3D box labels, where there is neither LiDAR nor a disparity map.

Only visible cars beyond 15 m are used, where the 10 cm by which a car lies within its box are at most 0.17 px. It gives
the constant and a slope, hardly more.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from directshape_torch.geometry.box3d import box_corners, pose_from_kitti
from directshape_torch.geometry.projection import project
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.io.kitti_labels import KittiObject
from directshape_torch.rig.detections import near_side_depth
from directshape_torch.rig.disparity_observations import KnownDepth

CLASSES = ("Car", "Van")
_NEAREST_M = 15.0
_FARTHEST_M = 60.0
_LARGEST_TRUNCATION = 0.05
_POINTS_PER_CAR = 400


def known_depth_from_labels(
    objects: Sequence[KittiObject],
    size_wh: tuple[int, int],
    camera: StereoCamera,  # one frame
) -> KnownDepth:
    """Pixels on the near sides of fully visible cars; empty where a frame has none."""
    parts = [
        known_depth_of_car(o, size_wh, camera)
        for o in objects
        if o.type in CLASSES
        and o.has_box_3d
        and o.occluded == 0
        and o.truncated <= _LARGEST_TRUNCATION
        and _NEAREST_M <= o.location_ref[2] <= _FARTHEST_M
    ]
    empty = torch.zeros(0, dtype=torch.float64)
    uv = torch.cat([empty.reshape(0, 2), *(part.uv_left for part in parts)])
    return KnownDepth(uv, torch.cat([empty, *(part.depth_m for part in parts)]))


def known_depth_of_car(
    car: KittiObject,
    size_wh: tuple[int, int],
    camera: StereoCamera,  # one frame
) -> KnownDepth:
    """Pixels on the near sides of one car, at most 400 of them, whether or not something hides it."""
    location_ref, rotation_y, hwl = _box(car)
    T_cam_obj = pose_from_kitti(location_ref + camera.t_cam_ref[0].double(), rotation_y)
    uv = _grid_in_box(project(box_corners(T_cam_obj, hwl), camera.K_left[0].double()), size_wh)
    depth = depth_of_near_side(car, uv, camera)
    chosen = _thinned(torch.nonzero(depth.isfinite())[:, 0])
    return KnownDepth(uv[chosen], depth[chosen])


def depth_of_near_side(
    car: KittiObject,
    uv_left: Tensor,  # (P, 2) pixels, float64
    camera: StereoCamera,  # one frame
) -> Tensor:  # (P,)
    """Depth at left pixels of the band of bumpers and doors, 10 cm within the car's box; NaN where a ray misses it.

    Examples:
        >>> from directshape_torch.io.kitti_labels import parse_object
        >>> from directshape_torch.files.text_files import Line
        >>> car = parse_object("labels", Line(1, "Car 0 0 0 0 0 9 9 1.5 1.6 4.0 0 1.6 22 -1.5708", ""))
        >>> P = torch.tensor([[[700.0, 0, 600, 0], [0, 700, 180, 0], [0, 0, 1, 0]]])
        >>> camera = StereoCamera.from_projections(P, P - torch.tensor([[[0.0, 0, 0, 378], [0] * 4, [0] * 4]]))
        >>> depth_of_near_side(car, torch.tensor([[600.0, 215.0], [100.0, 215.0]]).double(), camera)
        tensor([20.1000,     nan], dtype=torch.float64)
    """
    location_ref, rotation_y, hwl = _box(car)
    T_cam_obj = pose_from_kitti(location_ref + camera.t_cam_ref[0].double(), rotation_y)
    return near_side_depth(T_cam_obj, hwl, uv_left, camera.K_left[0].double())


def _box(car: KittiObject) -> tuple[Tensor, Tensor, Tensor]:
    """Bottom centre in `ref` (3,), heading (), and height, width, length (3,), float64."""
    location_ref, rotation_y, hwl = (
        torch.tensor(value, dtype=torch.float64) for value in (car.location_ref, car.rotation_y, car.hwl)
    )
    return location_ref, rotation_y, hwl


def _grid_in_box(corners_uv: Tensor, size_wh: tuple[int, int]) -> Tensor:
    low = corners_uv.amin(dim=0).floor().clamp_min(0).long().tolist()
    high = corners_uv.amax(dim=0).ceil().long().tolist()
    u = torch.arange(low[0], max(low[0], min(high[0], size_wh[0] - 1)) + 1)
    v = torch.arange(low[1], max(low[1], min(high[1], size_wh[1] - 1)) + 1)
    return torch.stack(torch.meshgrid(u, v, indexing="xy"), dim=-1).reshape(-1, 2).double()


def _thinned(index: Tensor) -> Tensor:
    """So many pixels a car at most, that near cars do not outvote far ones."""
    step = max(1, -(-len(index) // _POINTS_PER_CAR))
    return index[::step]
