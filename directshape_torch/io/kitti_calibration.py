"""This module reads KITTI calibration files of all layouts, their stereo camera, and AVOD's ground plane files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.files.text_files import Line, finite_numbers, read_lines
from directshape_torch.geometry.disparity_field import DisparityField
from directshape_torch.geometry.stereo_camera import StereoCamera

_PLANE_CURE = "write four lines: '# Plane', 'Width 4', 'Height 1', then a b c d with a x + b y + c z + d = 0"
# The names of each matrix in the object, the tracking, the raw and the odometry layout, and its shape.
_CAMERAS: dict[str, tuple[str, tuple[int, int]]] = {
    "P2": ("P2", (3, 4)),
    "P_rect_02": ("P2", (3, 4)),
    "P3": ("P3", (3, 4)),
    "P_rect_03": ("P3", (3, 4)),
    "R0_rect": ("R0_rect", (3, 3)),
    "R_rect": ("R0_rect", (3, 3)),
    "R_rect_00": ("R0_rect", (3, 3)),
    "Tr_velo_to_cam": ("Tr_velo_to_cam", (3, 4)),
    "Tr_velo_cam": ("Tr_velo_to_cam", (3, 4)),
    "Tr": ("Tr_velo_to_rect", (3, 4)),
}
_LIDAR = {"R": ("R", (3, 3)), "T": ("T", (3, 1))}


@dataclass(frozen=True)
class KittiCalibration:
    """A `KittiCalibration` has the matrices of one calibration file, float64."""

    path: Path  # the file
    # Projections of the left and the right colour camera from the `ref` frame, (3, 4), pixels.
    P2: NDArray[np.float64]
    P3: NDArray[np.float64]
    R0_rect: NDArray[np.float64] | None = None  # camera 0 to rectified camera 0, (3, 3), or None
    Tr_velo_to_cam: NDArray[np.float64] | None = None  # LiDAR to camera 0, (3, 4), metres, or None
    size_wh: tuple[int, int] | None = None  # size of the images, if the file has it
    names: tuple[str, str] = ("P2", "P3")  # names of the left and the right projection in the file

    def of_size(self, size_wh: tuple[int, int]) -> Self:
        """Return the calibration; a `DataFormatError` is raised if the file gives another image size."""
        if self.size_wh not in (None, size_wh):
            said, got = (" x ".join(map(str, size)) for size in (self.size_wh or (), size_wh))
            problem = f"is of images of {said} pixels, they have {got}"
            raise DataFormatError(self.path, problem, cure="give size and intrinsics of the images as they are")
        return self


def read_calibration(path: Path | str) -> KittiCalibration:
    """Read a KITTI calibration file.

    The file is `calib/NNNNNN.txt` of the object benchmark, `calib.txt` of a tracking or an odometry sequence, or
    `calib_cam_to_cam.txt` of a raw drive.
    """
    cure = "a stereo pair needs the projections P2 and P3 (of raw drives P_rect_02 and P_rect_03)"
    found, called = _read_matrices(path, _CAMERAS, ("P2", "P3"), cure)
    velo_to_rect = found.pop("Tr_velo_to_rect", None)
    if velo_to_rect is not None:
        # The matrix of the odometry benchmark includes the rotation to rectified images.
        found = {"R0_rect": np.eye(3), "Tr_velo_to_cam": velo_to_rect} | found
    return KittiCalibration(Path(path), **found, names=(called["P2"], called["P3"]))


def read_velo_to_cam(path: Path | str) -> NDArray[np.float64]:
    """LiDAR to camera 0, (3, 4), metres, from `calib_velo_to_cam.txt` of the raw recordings (lines `R:` and `T:`)."""
    cure = "a scan needs rotation and translation of its LiDAR"
    found, _ = _read_matrices(path, _LIDAR, ("R", "T"), cure)
    return np.concatenate([found["R"], found["T"]], axis=1)


def _read_matrices(
    path: Path | str, known: Mapping[str, tuple[str, tuple[int, int]]], needed: Sequence[str], cure: str
) -> tuple[dict[str, Any], dict[str, str]]:
    """The matrices in lines of `name: numbers`, with optional colon, and their names in the file.

    Other lines are ignored.
    """
    matrices, called = dict[str, Any](), dict[str, str]()
    for line in read_lines(path):
        words = line.text.split()
        name, shape = known.get(words[0].rstrip(":"), (None, (0, 0)))
        if name is not None:
            called[name] = words[0].rstrip(":")
            matrices[name] = finite_numbers(path, line, shape[0] * shape[1], words[1:]).reshape(shape)
    for name in needed:
        if name not in matrices:
            raise DataFormatError(path, f"has no line {name}:", cure=cure)
    return matrices, called


def to_stereo_camera(calibration: KittiCalibration) -> StereoCamera:
    """The camera of one frame, float64: `K = P2[:, :3]`, `x_cam = x_ref + K^-1 P2[:, 3]`, the right one from P3."""
    P2, P3 = (torch.from_numpy(matrix)[None] for matrix in (calibration.P2, calibration.P3))
    if not min(P2[0, 0, 0], P3[0, 0, 0]) > 0:
        problem = f"{' and '.join(calibration.names)} need focal lengths above 0"
        raise DataFormatError(calibration.path, problem, cure="check the order of the numbers")
    try:
        return StereoCamera.from_projections(P2, P3)
    except InputError as error:
        raise DataFormatError(calibration.path, _no_rig(calibration, error), cure=_cure_of_rig(calibration)) from error


def _no_rig(calibration: KittiCalibration, error: InputError) -> str:
    """The error of a rig in terms of the names in its file."""
    left, right = calibration.names
    if error.name != "P_right":
        return f"{left} and {right} describe no stereo rig: {error}"
    baseline = calibration.P2[0, 3] / calibration.P2[0, 0] - calibration.P3[0, 3] / calibration.P3[0, 0]
    return f"describes a right camera that is not to the right of the left one (baseline {baseline:.4f} m)"


def _cure_of_rig(calibration: KittiCalibration) -> str:
    left, right = calibration.names
    if left == "K_left":
        return "give baseline_m above 0, or t_right_cam_m with a first component below 0 (docs/plain_folder.md)"
    return f"{right}[0, 3] / fx must be below {left}[0, 3] / fx: were the two exchanged, or is a sign wrong?"


def camera_of_rig(
    calibration: KittiCalibration,
    fields: Sequence[DisparityField],
    size_wh: tuple[int, int],
    dtype: torch.dtype = torch.float32,
) -> StereoCamera:
    """The stereo camera of a frame, with the first disparity field that fits its rig, if any are given."""
    rig = to_stereo_camera(calibration.of_size(size_wh))
    refusal: InputError | None = None
    for field in fields:
        try:
            field.check_rig(size_wh, rig.K_left[0], rig.K_right[0], rig.T_right_cam[0])
        except InputError as error:
            refusal = refusal or error
        else:
            return replace(rig, disparity_field=field).to(dtype=dtype)
    if refusal is not None:
        raise refusal
    return rig.to(dtype=dtype)


def read_plane(path: Path | str) -> NDArray[np.float64]:
    """Read a plane `(a, b, c, d)`, `a x_ref + b y_ref + c z_ref + d = 0`, normalised and with its normal up (b < 0).

    The last line of the file is `a b c d`; lines before it are a header.
    """
    lines = read_lines(path)
    if not lines:
        raise DataFormatError(path, "is empty", cure=_PLANE_CURE)
    return upright_plane(path, finite_numbers(path, lines[-1], 4, cure=_PLANE_CURE), lines[-1])


def upright_plane(path: Path | str, plane: NDArray[np.float64], line: Line | None = None) -> NDArray[np.float64]:
    """A plane (a, b, c, d), normalised and with its normal up (b < 0)."""
    length = float(np.linalg.norm(plane[:3]))
    # A ground with a slope of more than 60 degrees means that the order or the frame of the coefficients is wrong.
    if not abs(plane[1]) > 0.5 * length:
        raise DataFormatError(
            path,
            "the normal is not near the vertical y axis",
            line_number=None if line is None else line.number,
            line=" ".join(map(str, plane)) if line is None else line.text,
            cure="see docs/plain_folder.md" if line is None else _PLANE_CURE,
        )
    return np.asarray(plane / (-np.sign(plane[1]) * length))


def plane_ref_to_cam(
    normal: Tensor,  # (*, 3), the same in both frames
    offset_ref: Tensor,  # (*,) metres
    t_cam_ref: Tensor,  # (*, 3) `x_cam = x_ref + t_cam_ref`
) -> Tensor:  # (*,)
    """Offset of a plane in camera coordinates, given in KITTI's reference frame: `d_cam = d_ref - n . t_cam_ref`.

    Examples:
        >>> import torch
        >>> up = torch.tensor([0.0, -1.0, 0.0])
        >>> plane_ref_to_cam(up, torch.tensor(1.65), torch.tensor([0.06, 0.01, 0.0]))
        tensor(1.6600)
    """
    return offset_ref - (normal * t_cam_ref).sum(dim=-1)
