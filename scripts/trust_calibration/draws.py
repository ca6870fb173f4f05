"""This module writes result files of simulated detectors: labels with random errors for each seed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from directshape_torch.files.atomic_files import write_text
from directshape_torch.geometry.box3d import alpha_from_kitti, box_corners, pose_from_kitti, wrap_angle
from directshape_torch.io.kitti_labels import KittiObject
from directshape_torch.io.stereo_dataset import StereoDataset
from directshape_torch.scene.frames import FrameBatch

_MEAN_HWL, _SIZE_SHARE = (1.53, 1.63, 3.88), 0.03
_LEAST_HEIGHT_PX = 25.0


class DetectorNoise(NamedTuple):
    """A `DetectorNoise` has standard deviations of a detector's errors."""

    depth_share: float  # of the position along the viewing ray, as a share of the distance
    side_m: float
    height_m: float
    yaw_deg: float
    flipped: float  # share of boxes that are rotated by 180 degrees


SIMULATED: Mapping[str, DetectorNoise] = {
    "stereo": DetectorNoise(0.025, 0.12, 0.05, 5.0, 0.0),
    "mono": DetectorNoise(0.05, 0.25, 0.10, 9.0, 0.05),
}
"""These are detectors as of a stereo pair and of one camera, both with cars of the mean size."""


def write_draws(dataset: StereoDataset, name: str, folders: Sequence[Path]) -> None:
    """Write the results of the named detector for labelled cars at least 25 px high, one draw in each folder."""
    noise = SIMULATED[name]
    for number, frame_id in enumerate(dataset.frame_ids):
        loaded = dataset.load(frame_id)
        cars = [
            label
            for label in loaded.labels or []
            if label.type == "Car" and label.box_2d[3] - label.box_2d[1] >= _LEAST_HEIGHT_PX
        ]
        for seed, folder in enumerate(folders):
            rng = np.random.default_rng([seed, number, list(SIMULATED).index(name)])
            lines = [_line(car, noise, rng, loaded.frame) for car in cars]
            write_text(folder / "data" / f"{frame_id}.txt", "".join(lines))


def _line(car: KittiObject, noise: DetectorNoise, rng: np.random.Generator, frame: FrameBatch) -> str:
    """One line of a result file."""
    along, side, up, turn, *sizes = rng.standard_normal(7).tolist()
    x, y, z = (value * (1 + noise.depth_share * along) for value in car.location_ref)
    distance = float(np.hypot(x, z))
    place = torch.tensor(
        [[x + noise.side_m * side * z / distance, y + noise.height_m * up, z - noise.side_m * side * x / distance]]
    ).double()
    flip = np.pi * float(rng.random() < noise.flipped)
    yaw = wrap_angle(torch.tensor([car.rotation_y + float(np.deg2rad(noise.yaw_deg)) * turn + flip]).double())
    hwl = torch.tensor([_MEAN_HWL]).double() * (1 + _SIZE_SHARE * torch.tensor([sizes]).double())
    corners = box_corners(pose_from_kitti(place + frame.camera.t_cam_ref[0].double(), yaw), hwl)[0]
    uv = (corners / corners[:, 2:].clamp_min(0.1)) @ frame.camera.K_left[0].double().T
    height, width = frame.sizes[0].tolist()
    last = torch.tensor([width - 1.0, height - 1.0]).double()
    low, high = (edge.clamp(min=torch.zeros(2).double(), max=last) for edge in (uv[:, :2].amin(0), uv[:, :2].amax(0)))
    alpha = alpha_from_kitti(place, yaw)
    numbers = torch.cat([alpha, low, high, hwl[0], place[0], yaw]).tolist()
    return "Car -1 -1 " + " ".join(f"{value:.4f}" for value in numbers) + " 0.9\n"
