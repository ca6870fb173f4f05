"""This module makes stereo cameras of rectified pairs of kornia's cameras."""

from __future__ import annotations

import torch
from kornia.geometry import camera as kornia_camera
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.geometry.disparity_field import DisparityField
from directshape_torch.geometry.se3 import from_rotation_translation
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.numerics.checks import check_rotation, check_shape

# Rectified cameras are turned by less: 1e-4 radians move a pixel by 0.07 at a focal length of 700.
_LARGEST_TURN = 1e-4
# Rectified cameras are displaced in height or depth by less than this share of the baseline; KITTI's are by 0.5 %.
_LARGEST_OFFSET = 0.05


def stereo_camera_of(
    left: kornia_camera.PinholeCamera | kornia_camera.StereoCamera,
    right: kornia_camera.PinholeCamera | None,
    disparity_field: DisparityField | None,
) -> StereoCamera:
    """See `StereoCamera.from_kornia`."""
    if isinstance(left, kornia_camera.StereoCamera):
        if right is not None:
            expected, cure = (
                "None beside kornia's StereoCamera, which has both",
                "leave it out, or give two PinholeCamera",
            )
            raise InputError("right", expected, type(right).__name__, cure)
        projections = left.rectified_left_camera, left.rectified_right_camera
        return StereoCamera.from_projections(*projections, disparity_field)
    pair = _pinhole("left", left), _pinhole("right", right)
    _check_alike(*pair)
    T_right_cam = _between_rectified(*pair)
    K_left, K_right = (camera.intrinsics[:, :3, :3].clone() for camera in pair)
    return StereoCamera(K_left, K_right, T_right_cam, torch.zeros_like(T_right_cam[:, :3, 3]), disparity_field)


def _pinhole(name: str, camera: object) -> kornia_camera.PinholeCamera:
    if not isinstance(camera, kornia_camera.PinholeCamera):
        expected = "kornia's PinholeCamera" + (" beside the left one" if name == "right" else " or StereoCamera")
        raise InputError(name, expected, type(camera).__name__, "for matrices there is from_projections")
    check_shape(f"{name}.intrinsics", camera.intrinsics, ("F", 4, 4), "give one camera a frame")
    check_shape(f"{name}.rt_matrix", camera.rt_matrix, (len(camera.intrinsics), 3, 4), "give one camera a frame")
    if camera.intrinsics.dtype not in (torch.float32, torch.float64):
        raise InputError(name, "float32 or float64", str(camera.intrinsics.dtype), "convert its matrices")
    check_rotation(name, camera.rt_matrix)
    return camera


def _check_alike(left: kornia_camera.PinholeCamera, right: kornia_camera.PinholeCamera) -> None:
    for what, of in (
        ("frames", lambda camera: camera.batch_size),
        ("dtype", lambda camera: camera.intrinsics.dtype),
        ("device", lambda camera: camera.device()),
        ("(height, width)", lambda camera: torch.stack([camera.height, camera.width], dim=1).tolist()),
    ):
        if of(left) != of(right):
            cure = "give both cameras of every frame, of images rectified to one size"
            raise InputError("right", f"the {what} of the left camera: {of(left)}", f"{of(right)}", cure)


def _between_rectified(left: kornia_camera.PinholeCamera, right: kornia_camera.PinholeCamera) -> Tensor:
    """`T_right_cam` (F, 4, 4), computed in float64, because the cameras may be far from the origin of their world."""
    R = right.rotation_matrix.double() @ left.rotation_matrix.double().mT
    t = (right.translation_vector.double() - R @ left.translation_vector.double())[..., 0]
    turn = (R - torch.eye(3).to(R)).detach().abs().amax(dim=(1, 2))
    offset = t.detach()[:, 1:].abs().amax(dim=1)
    askew = (turn > _LARGEST_TURN) | (offset > _LARGEST_OFFSET * t.detach()[:, 0].abs())
    if askew.any():
        row = int(askew.int().argmax())
        got = f"a turn by {turn[row]:.2g} and a translation by {[round(x, 4) for x in t[row].tolist()]} m in row {row}"
        cure = "rectify the images, and give the cameras of the rectified ones (cv2.stereoRectify)"
        raise InputError("right", "a rectified pair: parallel cameras, side by side", got, cure)
    return from_rotation_translation(R, t).to(right.intrinsics.dtype)
