"""True points of a frame for `directshape inspect`, from whatever truth lies in the data set's folder."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from directshape_torch.evaluation.shape_truth import SurfaceSource
from directshape_torch.geometry.camera import project, rays_from_pixels
from directshape_torch.io.frame_layout import FrameLayout, first_disparity
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.observation.extents import MASK_THRESHOLD
from directshape_torch.rig.disparity_maps import FOLDERS, known_depth_from_disparity_map
from directshape_torch.rig.disparity_observations import KnownDepth
from directshape_torch.rig.lidar import known_depth_from_lidar
from directshape_torch.visualize.inspection.car_view import KnownPoints

# Points under the mask's edge may lie far behind the car.
_REACH_M = 3.5


class TruePoints(NamedTuple):
    """Points that the left image of a frame shows."""

    name: str
    points_cam: NDArray[np.float64]  # (P, 3) metres
    uv: NDArray[np.float64]  # (P, 2) pixels


def true_points(root: Path, layout: FrameLayout, loaded: LoadedFrame) -> TruePoints | None:
    """The scan of a frame, or true disparity or surfaces in KITTI's folder `training`, the first that there is.

    Args:
        root: folder of the data set.
        layout: knows where the scan is.
        loaded: the frame.

    Raises:
        DataFormatError: a file is there and cannot be used.
    """
    training, frame_id, camera = root / "training", loaded.frame_id, loaded.frame.camera
    height, width = loaded.frame.sizes[0].tolist()
    scan = layout.scan(frame_id)
    if scan is not None:
        return _of_depth("LiDAR", known_depth_from_lidar(*scan, (width, height), camera), loaded)
    for folder in FOLDERS:
        disparity = first_disparity(training / folder, frame_id)
        if disparity.is_file():
            known = known_depth_from_disparity_map(disparity, (width, height), camera)
            return _of_depth("true disparity", known, loaded)
    return _of_surfaces(training, loaded)


def points_of_car(
    points: TruePoints | None, loaded: LoadedFrame, car: int, centre_cam: torch.Tensor
) -> KnownPoints | None:
    """The points of a frame and which of them are on a car: those in its left mask that are near its centre.

    Args:
        points: of the frame.
        loaded: the frame.
        car: row of the detections.
        centre_cam: (3,) a point of the car, metres.
    """
    if points is None:
        return None
    mask = loaded.detections.mask_left[car].numpy()
    u, v = np.rint(points.uv).astype(np.int64).T
    under_mask = mask[v, u] > MASK_THRESHOLD
    near = np.linalg.norm(points.points_cam - centre_cam.double().numpy(), axis=1) < _REACH_M
    return KnownPoints(points.name, points.points_cam, points.uv, np.asarray(under_mask & near))


def _of_depth(name: str, known: KnownDepth, loaded: LoadedFrame) -> TruePoints:
    rays = rays_from_pixels(known.uv_left, loaded.frame.camera.K_left[0].double())
    return TruePoints(name, (known.depth_m[:, None] * rays).numpy(), known.uv_left.numpy())


def _of_surfaces(training: Path, loaded: LoadedFrame) -> TruePoints | None:
    """The visible points of all labelled cars of a rendered scene."""
    camera, frame_id = loaded.frame.camera, loaded.frame_id
    if loaded.labels is None or not any((training / "points").glob(f"{frame_id}_*.npz")):
        return None
    truths = SurfaceSource(training).truths(frame_id, loaded.labels, camera).values()
    visible = np.concatenate([truth.points_cam[truth.visible] for truth in truths])
    uv = project(torch.from_numpy(visible), camera.K_left[0].double()).numpy()
    return TruePoints("true surface", visible, uv)
