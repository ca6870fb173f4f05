"""The stereo points of each refined car, from disparity maps that are given or matched on the spot."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from directshape_torch.config import PointCloudConfig
from directshape_torch.export.visible_surface import FrameView, Points
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.observation.car_points import car_points
from directshape_torch.stereo_matching.disparity import with_disparity

_ALL_POINTS = 10_000_000


@dataclass(frozen=True)
class StereoPoints:
    """N points measured by dense stereo on one car.

    Attributes:
        points_cam: (N, 3) metres, left camera frame.
        rgb: (N, 3) their pixels' colours, sRGB.
    """

    points_cam: Points
    rgb: NDArray[np.uint8]


def stereo_points(loaded: LoadedFrame, view: FrameView) -> Mapping[int, StereoPoints]:
    """Points of every pixel of each car of a frame, by its line number.

    A car's pixels are those of its left mask, of its 2D box where it has none; kept are those above the ground and near
    the car, as the point cloud methods of the refinement take them. The rig's bias is taken off where it is known.
    """
    frames = with_disparity(loaded.frame)
    samples = car_points(frames, loaded.detections, replace(PointCloudConfig(), max_points=_ALL_POINTS))
    rows, points_cam = samples.object_index.numpy(), samples.points_cam.double().numpy()
    found = {}
    for row, detected in enumerate(loaded.detected_objects):
        own = points_cam[rows == row]
        found[detected.line_number] = StereoPoints(own, view.colours(own))
    return found
