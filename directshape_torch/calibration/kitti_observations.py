"""Observations of a rig's disparity from frames in KITTI's folder layout, from any of the three kinds of truth."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import torch

from directshape_torch.calibration.disparity_observations import DisparityObservations, KnownDepth, observe_disparity
from directshape_torch.calibration.observations_disparity import FOLDERS, known_depth_from_disparity_map
from directshape_torch.calibration.observations_labels import known_depth_from_labels
from directshape_torch.calibration.observations_lidar import known_depth_from_lidar
from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.geometry.disparity_field import DisparityField
from directshape_torch.io.image_files import find_image, read_rgb
from directshape_torch.io.kitti_calibration import KittiCalibration, read_calibration, to_stereo_camera
from directshape_torch.io.kitti_labels import read_objects
from directshape_torch.scene import StereoCamera

TruthSource = Literal["disparity", "lidar", "labels"]


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
    folders, ending = {
        "disparity": (FOLDERS, "png"),
        "lidar": (("velodyne",), "bin"),
        "labels": (("label_2",), "txt"),
    }[source]
    files = {path.stem: path for folder in folders for path in sorted((training / folder).glob(f"*.{ending}"))}
    if not files:
        wanted = " or ".join(f"training/{folder}/*.{ending}" for folder in folders)
        raise DataFormatError(
            root, f"holds no {wanted}", cure=f"choose one of --from {', '.join(get_args(TruthSource))}"
        )
    return dict(sorted(files.items()))


def choose_frames(files: dict[str, Path], frames: Sequence[str] | None) -> tuple[str, ...]:
    """The wanted frame ids, all if `frames` is None.

    Raises:
        InputError: one of them has no file.
    """
    if frames is None:
        return tuple(files)
    missing = [frame for frame in frames if frame not in files]
    if missing:
        raise InputError("frames", f"ids among {', '.join(list(files)[:5])} ...", ", ".join(missing[:5]))
    return tuple(dict.fromkeys(frames))


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


def check_one_rig(frames: Iterable[RigFrame]) -> None:
    """Refuse frames of several rigs or image sizes.

    Raises:
        InputError: names the first frame that does not belong to the rig of the first.
    """
    first: DisparityField | None = None
    for frame in frames:
        rig = (frame.size_wh, frame.camera.K_left[0], frame.camera.K_right[0], frame.camera.T_right_cam[0])
        if first is None:
            first = DisparityField.constant(0.0, *rig)
        try:
            first.check_rig(*rig)
        except InputError as error:
            cure = "choose frames of one rig with --frames"
            raise InputError("frames", "frames of one rig", f"{frame.frame_id} of another ({error})", cure) from error


def _known_depth(
    truth: Path, source: TruthSource, size_wh: tuple[int, int], camera: StereoCamera, calibration: KittiCalibration
) -> KnownDepth:
    if source == "disparity":
        return known_depth_from_disparity_map(truth, size_wh, camera)
    if source == "lidar":
        return known_depth_from_lidar(truth, calibration, size_wh, camera)
    return known_depth_from_labels(read_objects(truth, with_score=False), size_wh, camera)
