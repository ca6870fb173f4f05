"""`StereoCamera` holds the calibration of rectified pairs, from intrinsics, projections or kornia's cameras."""

from __future__ import annotations

from dataclasses import dataclass
from types import NoneType
from typing import TYPE_CHECKING, Annotated

import numpy as np
import torch
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.geometry.disparity_field import DisparityField
from directshape_torch.geometry.se3 import from_rotation_translation
from directshape_torch.numerics.checks import (
    check_alike,
    check_finite,
    check_positive,
    check_rotation,
    check_rows,
    check_shape,
    check_type,
)
from directshape_torch.numerics.conversion import Given, as_floating
from directshape_torch.numerics.full_precision import in_full_precision
from directshape_torch.numerics.records import Dense, TensorRecord

if TYPE_CHECKING:
    from kornia.geometry import camera as kornia_camera


@dataclass(frozen=True)
class StereoCamera(TensorRecord):
    """A `StereoCamera` is the calibration of the F rectified stereo frames of a call.

    Attributes:
        K_left: intrinsics of the left camera, (F, 3, 3), pixels.
        K_right: intrinsics of the right camera, (F, 3, 3), pixels.
        T_right_cam: left camera to right camera, (F, 4, 4), metres. Any rigid transform: KITTI's right camera is also
            2.7 mm off vertically.
        t_cam_ref: `x_cam = x_ref + t_cam_ref`, (F, 3): `ref` is the frame of labels and result files (KITTI: rectified
            camera 0). It is zero where `ref` is the left camera frame.
        disparity_field: residual disparity of the rig (measured minus true), or None.

    Raises:
        InputError: wrong shapes, numbers that are not finite, a matrix that is no rotation, or a right camera that is
            not to the right of the left one.
    """

    K_left: Annotated[Tensor, Dense("F", 3, 3)]
    K_right: Annotated[Tensor, Dense("F", 3, 3)]
    T_right_cam: Annotated[Tensor, Dense("F", 4, 4)]
    t_cam_ref: Annotated[Tensor, Dense("F", 3)]
    disparity_field: DisparityField | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check_type("disparity_field", self.disparity_field, (DisparityField, NoneType))
        for name in ("K_left", "K_right", "T_right_cam", "t_cam_ref"):
            check_finite(name, getattr(self, name), "check the calibration of every frame")
        check_rotation("T_right_cam", self.T_right_cam)
        if (self.baseline <= 0).any():
            raise InputError(
                "T_right_cam",
                "a right camera to the right of the left one (positive baseline)",
                f"baseline {self.baseline.min().item():.4f} m",
                "swap the two cameras, or flip the sign of the translation: x_right = x_left + t has t_x = -baseline",
            )

    @classmethod
    def from_intrinsics(
        cls,
        K: Given,  # (3, 3) or (F, 3, 3)
        baseline_m: float | Given,  # a number or (F,)
        K_right: Given | None = None,
        disparity_field: DisparityField | None = None,
    ) -> StereoCamera:
        """An ideal rectified pair: parallel cameras side by side, and labels in the frame of the left one.

        The camera is float64 where K is, as arrays mostly are, else float32; `FrameBatch.from_images` converts it to
        the dtype of its images.

        Args:
            K: intrinsics of the images, pixels; one matrix for one frame, or one for each of F frames.
            baseline_m: distance of the two cameras, metres, positive.
            K_right: intrinsics of the right images where they differ.
            disparity_field: residual disparity of the rig (measured minus true), or None.

        Raises:
            InputError: other shapes or types, intrinsics that are not `[[fx, s, cx], [0, fy, cy], [0, 0, 1]]` with
                positive focal lengths, or a baseline that is not above 0.

        Examples:
            >>> K = torch.tensor([[700.0, 0.0, 600.0], [0.0, 700.0, 180.0], [0.0, 0.0, 1.0]])
            >>> StereoCamera.from_intrinsics(K, 0.54).baseline
            tensor([0.5400])
        """
        K_left = _intrinsics("K", K)
        of_right = K_left if K_right is None else _intrinsics("K_right", K_right)
        if len(of_right) not in (1, len(K_left)):
            expected, cure = f"one matrix, or {len(K_left)} as K has", "give one K_right for all frames or one for each"
            raise InputError("K_right", expected, f"{len(of_right)}", cure)
        if isinstance(baseline_m, (Tensor, np.ndarray, list, tuple)):
            baseline_m = as_floating(baseline_m, K_left)
            check_shape("baseline_m", baseline_m, (len(K_left),) if baseline_m.ndim else (), kind="floating")
        else:
            cure = "give the distance of the cameras in metres; of projections it is -P_right[0, 3] / P_right[0, 0]"
            check_positive("baseline_m", baseline_m, cure)
        T_right_cam = torch.eye(4).to(K_left).repeat(len(K_left), 1, 1)
        T_right_cam[:, 0, 3] = -torch.as_tensor(baseline_m, dtype=K_left.dtype, device=K_left.device)
        of_right = of_right.expand_as(K_left).clone()
        return cls(K_left.clone(), of_right, T_right_cam, torch.zeros_like(K_left[:, 0]), disparity_field)

    @classmethod
    def from_projections(
        cls,
        P_left: Given,  # (3, 4) or (F, 3, 4)
        P_right: Given,  # (3, 4) or (F, 3, 4)
        disparity_field: DisparityField | None = None,
    ) -> StereoCamera:
        """The rectified pair of two projections: P2 and P3 of KITTI, P of both `camera_info` of ROS, P1 and P2 of
        OpenCV's `stereoRectify`.

        `K = P[:, :3]`, `t_left = K^-1 P_left[:, 3]`, `T_right_cam = [I, t_right - t_left]`: the baseline of an ideal
        pair is `-P_right[0, 3] / P_right[0, 0]`. The matrix K of a `camera_info` belongs to the raw images.

        The camera is float64 where `P_left` is, else float32.

        Raises:
            InputError: wrong shapes or types, a K that has no inverse, or a right camera that is not to the right of
                the left one.

        Examples:
            >>> K = torch.tensor([[700.0, 0.0, 600.0], [0.0, 700.0, 180.0], [0.0, 0.0, 1.0]])
            >>> shift = torch.tensor([[-378.0], [0.0], [0.0]])
            >>> P_left = torch.cat([K, torch.zeros(3, 1)], dim=1)
            >>> P_right = torch.cat([K, shift], dim=1)
            >>> StereoCamera.from_projections(P_left, P_right).baseline
            tensor([0.5400])
        """
        cure = "give the projections P, whose fourth column holds the baseline; with K alone there is from_intrinsics"
        P_left = as_floating(P_left)
        is_one = isinstance(P_left, Tensor) and P_left.ndim == 2
        check_shape("P_left", P_left, (3, 4) if is_one else ("F", 3, 4), cure, "floating")
        P_right = as_floating(P_right, P_left)
        check_shape("P_right", P_right, P_left.shape, cure, "floating")
        check_alike("P_right", P_right, "P_left", P_left)
        if is_one:
            P_left, P_right = P_left[None], P_right[None]
        K_left, K_right = P_left[..., :3], P_right[..., :3]
        t_left, t_right = _translation("P_left", P_left), _translation("P_right", P_right)
        T_right_cam = torch.eye(4, dtype=P_left.dtype, device=P_left.device).repeat(len(P_left), 1, 1)
        T_right_cam[:, :3, 3] = t_right - t_left
        not_right = ~(t_right[:, 0] < t_left[:, 0]) & P_right.isfinite().flatten(1).all(dim=1)
        expected = "fourth columns with P_right[0, 3] = -fx baseline + P_left[0, 3], the baseline above 0"
        cure = "swap P_left and P_right, or take the right camera's own P (in its camera_info P[0, 3] is below 0)"
        check_rows("P_right", not_right, P_right, expected, cure)
        return cls(K_left.clone(), K_right.clone(), T_right_cam, t_left, disparity_field)

    @classmethod
    def from_kornia(
        cls,
        left: kornia_camera.PinholeCamera | kornia_camera.StereoCamera,
        right: kornia_camera.PinholeCamera | None = None,
        disparity_field: DisparityField | None = None,
    ) -> StereoCamera:
        """The rectified pair of kornia's `PinholeCamera`, or of its `StereoCamera`, of F frames each.

        kornia has the same pixels and axes: centres at integers, x right, y down, z forward. Extrinsics (world to
        camera) and projections are taken to be in metres. A pair keeps `T_right_cam` but no world: `ref` is the left
        camera itself. The height and width of the images belong to `FrameBatch.sizes`. Dtype, device and
        gradients are kept.

        Args:
            left: a `StereoCamera`, which has both cameras, or the camera of the left images, with intrinsics and
                extrinsics (F, 4, 4).
            right: the camera of the right images; None with a `StereoCamera`.
            disparity_field: residual disparity of the rig (measured minus true), or None.

        Raises:
            InputError: other types, a pair whose batch, image size, dtype or device differ, a matrix that is no
                rotation, cameras that are not rectified (turned by more than 1e-4 radians, or displaced by more than
                5 % of the baseline in height or depth), or a right camera that is not to the right of the left one.

        Examples:
            >>> K, T_right_cam = torch.eye(4)[None], torch.eye(4)[None].clone()
            >>> K[0, 0, 0] = K[0, 1, 1] = 700.0
            >>> T_right_cam[0, 0, 3] = -0.54
            >>> height, width = torch.tensor([375]), torch.tensor([1242])
            >>> from kornia.geometry.camera import PinholeCamera
            >>> left = PinholeCamera(K, torch.eye(4)[None], height, width)
            >>> right = PinholeCamera(K, T_right_cam, height, width)
            >>> StereoCamera.from_kornia(left, right).baseline
            tensor([0.5400])
        """
        from directshape_torch.geometry.kornia_cameras import stereo_camera_of

        return stereo_camera_of(left, right, disparity_field)

    @property
    def num_frames(self) -> int:
        return len(self.K_left)

    @property
    def baseline(self) -> Tensor:
        """Distance of the right camera along the left camera's x axis, (F,), metres, positive."""
        return -self.T_right_cam[:, 0, 3]

    @torch.no_grad()
    @in_full_precision
    def field_sigma_px(self, frame_index: Tensor, points_cam: Tensor) -> Tensor:
        """Standard deviation (P,) of the disparity field where points (P, 3) of frames (P,) are seen; 0 without it.

        Points beyond the image get the value at the border, because the polynomial has no data outside.
        """
        if self.disparity_field is None:
            return torch.zeros_like(points_cam[:, 0])
        in_image = (self.K_left[frame_index] @ points_cam[..., None])[..., 0]
        u, v = (in_image[:, :2] / in_image[:, 2:].clamp_min(1e-3)).unbind(1)
        width, height = self.disparity_field.size_wh
        return self.disparity_field.sigma(torch.stack([u.clamp(0, width - 1), v.clamp(0, height - 1)], dim=1))

    @property
    def T_cam_ref(self) -> Tensor:
        """The motion from the frame of labels and result files to the left camera, (F, 4, 4)."""
        return from_rotation_translation(torch.eye(3).to(self.t_cam_ref).expand_as(self.K_left), self.t_cam_ref)


def _intrinsics(name: str, K: Given) -> Tensor:
    """Intrinsics (F, 3, 3) of one frame or of F, checked."""
    K = as_floating(K)
    shape = (3, 3) if isinstance(K, Tensor) and K.ndim == 2 else ("F", 3, 3)
    is_projection = isinstance(K, Tensor) and K.shape[-2:] == (3, 4)
    cure = "for projections P there is from_projections(P_left, P_right)" if is_projection else ""
    check_shape(name, K, shape, cure, kind="floating")
    K = K if K.ndim == 3 else K[None]
    last_row = K.new_tensor([0.0, 0.0, 1.0])
    if not bool(((K[:, 2] == last_row).all(1) & (K[:, 1, 0] == 0) & (K[:, 0, 0] > 0) & (K[:, 1, 1] > 0)).all()):
        cure = "give K of the rectified images as rows, in pixels; this may be its transpose or its inverse"
        raise InputError(name, "[[fx, s, cx], [0, fy, cy], [0, 0, 1]], pixels", f"{K.tolist()}", cure)
    return K


def _translation(
    name: str,
    P: Tensor,  # (F, 3, 4)
) -> Tensor:
    """`K^-1 P[:, 3]`, (F, 3)."""
    try:
        t: Tensor = torch.linalg.solve(P[..., :3], P[..., 3:])[..., 0]
        return t
    except torch.linalg.LinAlgError as error:  # type: ignore[attr-defined]
        cure = "give the projections of the rectified cameras (KITTI: P2 and P3)"
        raise InputError(name, "intrinsics K = P[:, :3] that can be inverted", "a singular K", cure) from error
