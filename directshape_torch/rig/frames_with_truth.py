"""Observations of a rig's disparity from frames in KITTI's folder layout, from scans or disparity maps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import torch

from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.io.image_files import find_image, read_rgb
from directshape_torch.io.kitti_calibration import KittiCalibration, read_calibration, to_stereo_camera
from directshape_torch.rig.disparity_maps import FOLDERS, known_depth_from_disparity_map
from directshape_torch.rig.disparity_observations import (
    DisparityObservations,
    KnownDepth,
    concatenate,
    observe_disparity,
)
from directshape_torch.rig.estimate import RigEstimate, rig_among
from directshape_torch.rig.lidar import known_depth_from_lidar
from directshape_torch.rig.pixels import pixel_evidence

TruthSource = Literal["disparity", "lidar"]


@dataclass(frozen=True)
class RigFrame:
    """One observed frame.

    Attributes:
        frame_id: its name.
        size_wh: width and height of the images.
        camera: its calibration.
        observations: measured against true disparity.
    """

    frame_id: str
    size_wh: tuple[int, int]
    camera: StereoCamera
    observations: DisparityObservations


def truth_files(root: Path, source: TruthSource) -> dict[str, Path]:
    """The files of a source by frame id; of a stereo pair 2015 the first image (`NNNNNN_10`) keeps its full name.

    Raises:
        DataFormatError: there is no `root/training` or no file of that kind in it.
    """
    training = root / "training"
    if not training.is_dir():
        raise DataFormatError(root, "holds no folder 'training'", cure="give the folder above it, in KITTI's layout")
    folders, ending = (FOLDERS, "png") if source == "disparity" else (("velodyne",), "bin")
    files = {path.stem: path for folder in folders for path in sorted((training / folder).glob(f"*.{ending}"))}
    if not files:
        wanted = " or ".join(f"training/{folder}/*.{ending}" for folder in folders)
        raise DataFormatError(
            root, f"holds no {wanted}", cure=f"choose one of --from {', '.join(get_args(TruthSource))}"
        )
    return dict(sorted(files.items()))


def chosen_frames(known: Sequence[str], frames: Sequence[int | str] | None) -> list[str]:
    """The wanted frames among those that are known, a number for a name with leading zeros; all if `frames` is None.

    Raises:
        InputError: one of them is not known.

    Examples:
        >>> chosen_frames(["000107", "007322"], [107])
        ['000107']
    """
    if frames is None:
        return list(known)
    by_word = {word: name for name in known for word in (name, int(name) if name.isdecimal() else name)}
    missing = [str(frame) for frame in frames if frame not in by_word]
    if missing:
        raise InputError("frames", f"ids among {', '.join(known[:5])} ...", ", ".join(missing[:5]), "check --frames")
    return list(dict.fromkeys(by_word[frame] for frame in frames))


def observe_frame(root: Path, frame_id: str, truth: Path, source: TruthSource) -> RigFrame:
    """Read one frame and measure its disparities where the truth is known.

    Raises:
        DataFormatError: a file is missing or damaged.
    """
    training = root / "training"
    calibration = read_calibration(training / "calib" / f"{frame_id}.txt")
    camera = to_stereo_camera([calibration], dtype=torch.float64)
    left, right = (read_rgb(find_image(training / name, frame_id)) for name in ("image_2", "image_3"))
    if left.shape != right.shape:
        raise DataFormatError(
            training / "image_3" / frame_id, f"has size {right.shape[:2]}, the left image {left.shape[:2]}"
        )
    size_wh = (left.shape[1], left.shape[0])
    known = _known_depth(truth, source, size_wh, camera, calibration)
    return RigFrame(frame_id, size_wh, camera, observe_disparity(left, right, camera, known))


def add_truth(rigs: list[RigEstimate], source: TruthSource, frames: Sequence[RigFrame]) -> None:
    """The evidence of observed frames to the estimates of their rigs; new rigs join the list.

    Raises:
        InputError: fewer than 50 pixels of known and measured disparity for one of the rigs.
    """
    of_rig: dict[RigEstimate, list[RigFrame]] = {}
    for frame in frames:
        camera = frame.camera
        rig = rig_among(rigs, frame.size_wh, camera.K_left[0], camera.K_right[0], camera.T_right_cam[0])
        of_rig.setdefault(rig, []).append(frame)
    for rig, seen in of_rig.items():
        observations = concatenate([frame.observations for frame in seen])
        rig.add_pixels(source, pixel_evidence(observations, seen[0].size_wh, len(seen)))


def _known_depth(
    truth: Path, source: TruthSource, size_wh: tuple[int, int], camera: StereoCamera, calibration: KittiCalibration
) -> KnownDepth:
    if source == "disparity":
        return known_depth_from_disparity_map(truth, size_wh, camera)
    return known_depth_from_lidar(truth, calibration, size_wh, camera)
