"""`Rig` describes the images and cameras that an estimate, a field or an observation belongs to."""

from __future__ import annotations

from typing import NamedTuple, Self

import torch
from torch import Tensor

from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.geometry.stereo_depth import depth_from_disparity, disparity_of_depth
from directshape_torch.scene.frames import FrameBatch


class Rig(NamedTuple):
    """This is one calibrated stereo pair, float64 on the CPU. It does not contain a disparity field of its camera."""

    size_wh: tuple[int, int]  # of the images
    K_left: Tensor  # (3, 3) pixels
    K_right: Tensor  # (3, 3)
    T_right_cam: Tensor  # (4, 4) metres

    @classmethod
    def of(cls, camera: StereoCamera, size_wh: tuple[int, int], number: int = 0) -> Self:
        """The rig of one of the frames of a camera."""
        matrices = (camera.K_left, camera.K_right, camera.T_right_cam)
        return cls(size_wh, *(matrix[number].detach().to("cpu", torch.float64) for matrix in matrices))

    @classmethod
    def of_frame(cls, frames: FrameBatch, number: int = 0) -> Self:
        """The rig of the frame with the given number."""
        height, width = frames.sizes[number].tolist()
        return cls.of(frames.camera, (width, height), number)

    def displacement(self, uv_left: Tensor, depth: Tensor) -> Tensor:
        """True disparity and row shift (P, 2) of left pixels (P, 2) of known depth (P,)."""
        return disparity_of_depth(uv_left, depth, *self[1:])

    def of_depth(self, disparity: Tensor) -> Tensor:
        """Part of disparities (P,) that falls as 1 / depth, without the constant from different principal points."""
        return disparity - (self.K_left[0, 2] - self.K_right[0, 2])

    def depth(self, uv_left: Tensor, disparity: Tensor) -> Tensor:
        """Depth (P,) of left pixels (P, 2) with a true disparity (P,); NaN if no point in front has it."""
        return depth_from_disparity(uv_left, disparity, *self[1:])
