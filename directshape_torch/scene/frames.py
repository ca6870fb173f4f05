"""This module holds the stereo frames that a refinement is given, as plain tensors.

It knows no data set and no solver. Everything is in the left camera frame (`cam`): x right, y down, z forward, metres;
pixels are (u, v) = (column, row) with the centre of the top-left pixel at (0, 0).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.geometry.ground_plane import GroundPlane
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.numerics.checks import (
    check_finite,
    check_rotation,
    check_rows,
    check_shape,
    check_type,
    check_words,
)
from directshape_torch.numerics.conversion import Given, as_floating, as_tensor, working_dtype
from directshape_torch.numerics.records import Dense, TensorRecord

Side = Literal["left", "right"]
SIDES: tuple[Side, Side] = ("left", "right")
"""A frame has these two images."""

# Resampling by cubic kernels overshoots by a quarter at an edge; normalised images and 0..255 go far beyond.
_BRIGHTEST = 1.5
_DARKEST = -0.5
# Times and places of a path must be exact to these steps.
_FINE_S, _FINE_M = 1e-3, 0.01


@dataclass(frozen=True)
class FrameBatch(TensorRecord):
    """A `FrameBatch` is F stereo frames, padded at the right and bottom to one size.

    Attributes:
        images_left: (F, 3, H, W), RGB in [0, 1].
        images_right: (F, 3, H, W).
        sizes: (F, 2) int64 or int32 (height, width) of each frame without padding.
        camera: calibration of the frames.
        ground: a ground plane for each frame, in the left camera frame.
        frame_ids: a name for each frame.
        disparity: (F, H, W) measured `u_left - u_right` of the left pixels, NaN where unknown, for settings that fit
            a point cloud; without it (None) the images are matched.
        points_cam: (F, P, 3) points of a LiDAR in the left camera frame, metres, NaN where a frame has fewer than P,
            for `terms.lidar`; None where there are none.
        time_s: (F,) when each frame was taken, seconds from any beginning that keeps them small; with `track_id` a car
            then moves along a smooth path (docs/tracks.md). None where times are unknown: each frame is by itself.
        T_world_cam: (F, 4, 4) pose of the left camera in one world for all frames of a track, which must be near the
            origin, because float32 has seven digits. None where poses are unknown: paths are relative to the camera.
    """

    images_left: Annotated[Tensor, Dense("F", 3, "H", "W", kind="image", cure="stack images as (F, 3, H, W) in [0, 1]")]
    images_right: Annotated[Tensor, Dense("F", 3, "H", "W", kind="image")]
    sizes: Annotated[Tensor, Dense("F", 2, kind="index")]
    camera: StereoCamera
    ground: GroundPlane
    frame_ids: tuple[str, ...]
    disparity: Annotated[Tensor | None, Dense("F", "H", "W")] = None
    points_cam: Annotated[Tensor | None, Dense("F", "P", 3)] = None
    time_s: Annotated[Tensor | None, Dense("F")] = None
    T_world_cam: Annotated[Tensor | None, Dense("F", 4, 4)] = None

    def __post_init__(self) -> None:
        super().__post_init__()
        num_frames, _, height, width = self.images_left.shape
        _check_brightness("images_left", self.images_left)
        _check_brightness("images_right", self.images_right)
        check_words("frame_ids", self.frame_ids, num_frames, "names")
        check_type("camera", self.camera, (StereoCamera,))
        check_type("ground", self.ground, (GroundPlane,))
        for name, count in (("camera", self.camera.num_frames), ("ground", len(self.ground.normal))):
            if count != num_frames:
                cure = f"give one for each of the {num_frames} left images"
                raise InputError(name, f"{num_frames} frames", f"{count}", cure)
        if num_frames and bool(((self.sizes > self.sizes.new_tensor([height, width])) | (self.sizes < 1)).any()):
            expected, cure = f"(height, width) within (1..{height}, 1..{width})", "height comes first, without padding"
            raise InputError("sizes", expected, str(self.sizes.tolist()), cure)
        _check_motion(self.time_s, self.T_world_cam)
        field = self.camera.disparity_field
        if field is not None:
            for k in range(num_frames):
                h, w = (int(n) for n in self.sizes[k])
                field.check_rig((w, h), self.camera.K_left[k], self.camera.K_right[k], self.camera.T_right_cam[k])

    @classmethod
    def from_images(
        cls,
        images_left: Given,  # (F, 3, H, W), or (3, H, W) of one frame
        images_right: Given,
        camera: StereoCamera,
        ground: GroundPlane | float | Given = 1.65,
        frame_ids: Sequence[str] | None = None,
        time_s: Given | None = None,
        T_world_cam: Given | None = None,
    ) -> FrameBatch:
        """Frames without padding, of RGB images in floating point in [0, 1] or uint8.

        All inputs, also camera, ground, times and poses, are moved to the device and the dtype of the left images. The
        dtype is float64 for tensors of float64, else float32, also for arrays, bytes and half precision.

        Args:
            images_left, images_right: rectified pairs.
            camera: of F frames, or of one for all of them.
            ground: planes, or the height of the camera above a level road, metres.
            frame_ids: names; default "000000", "000001" and so on.
            time_s, T_world_cam: see the class.

        Raises:
            InputError: what the class raises.

        Examples:
            >>> K = torch.tensor([[700.0, 0.0, 200.0], [0.0, 700.0, 60.0], [0.0, 0.0, 1.0]])
            >>> image = torch.zeros(3, 120, 400, dtype=torch.uint8)
            >>> frames = FrameBatch.from_images(image, image, StereoCamera.from_intrinsics(K, 0.54), ground=1.65)
            >>> frames.sizes, frames.frame_ids
            (tensor([[120, 400]]), ('000000',))
        """
        check_type("camera", camera, (StereoCamera,))
        left, right = _as_images("images_left", images_left), _as_images("images_right", images_right)
        count = len(left)
        if camera.num_frames == 1:
            camera = camera.rows(torch.zeros(count, dtype=torch.long))
        if not isinstance(ground, GroundPlane):
            ground = GroundPlane.from_camera_height(ground, count)
        camera, ground = camera.to(left.device, left.dtype), ground.to(left.device, left.dtype)
        time_s, T_world_cam = (as_floating(values, left) for values in (time_s, T_world_cam))
        sizes = torch.tensor([left.shape[2:]] * count, device=left.device).reshape(count, 2)
        names = tuple(f"{number:06d}" for number in range(count)) if frame_ids is None else frame_ids
        check_type("frame_ids", names, (tuple, list))
        right = right if right.dtype == left.dtype else right.to(left.dtype)
        return cls(left, right, sizes, camera, ground, tuple(names), time_s=time_s, T_world_cam=T_world_cam)

    def __len__(self) -> int:
        return len(self.images_left)


def _as_images(name: str, images: Given) -> Tensor:
    """RGB images (F, 3, H, W) in [0, 1], in float32 or float64."""
    dtype = working_dtype(images.dtype) if isinstance(images, Tensor) else torch.float32
    images = as_tensor(images)
    shape = (3, "H", "W") if isinstance(images, Tensor) and images.ndim == 3 else ("F", 3, "H", "W")
    is_bytes = isinstance(images, Tensor) and images.dtype == torch.uint8
    check_shape(name, images, shape, "colours come first: image.permute(2, 0, 1)", "number" if is_bytes else "image")
    images = images if images.ndim == 4 else images[None]
    return images.to(dtype) / 255 if is_bytes else images.to(dtype)


def _check_motion(time_s: Tensor | None, T_world_cam: Tensor | None) -> None:
    if time_s is not None:
        check_finite("time_s", time_s, "leave it out where times are not known")
        _check_fine("time_s", time_s, _FINE_S, "s")
    if T_world_cam is None:
        return
    check_finite("T_world_cam", T_world_cam, "leave it out where poses are not known")
    check_rotation("T_world_cam", T_world_cam)
    not_last = (T_world_cam[:, 3] != T_world_cam.new_tensor([0.0, 0.0, 0.0, 1.0])).any(dim=1)
    check_rows("T_world_cam", not_last, T_world_cam, "0, 0, 0, 1 as last rows")
    _check_fine("T_world_cam", T_world_cam[:, :3, 3], _FINE_M, "m")


def _check_fine(name: str, values: Tensor, fine: float, unit: str) -> None:
    """Raise `InputError` where the numbers of a dtype are further apart than `fine`."""
    spacing = torch.finfo(values.dtype).eps * float(values.detach().abs().max()) if values.numel() else 0.0
    if spacing > fine:
        came = f"{values.dtype} {float(values.detach().abs().max()):g} {unit}, which is known to {spacing:.2g} {unit}"
        raise InputError(name, f"numbers near 0, exact to {fine:g} {unit}", came, "take those of the first frame off")


def _check_brightness(name: str, images: Tensor) -> None:
    """Raise `InputError` for values far outside of [0, 1]; values that are not finite fail the cars that need them."""
    if not images.numel():
        return
    values = images.detach()
    darkest, brightest = torch.stack(values.aminmax()).tolist()
    if not math.isfinite(brightest - darkest):
        # One NaN hides all other values. Images are copied without NaN only where they have one.
        finite = values.nan_to_num(nan=0.0, posinf=0.0, neginf=0.0)
        darkest, brightest = torch.stack(finite.aminmax()).tolist()
    if darkest < _DARKEST:
        cure = "undo the normalisation: images are RGB in [0, 1]"
        raise InputError(name, "values in [0, 1]", f"a value of {darkest:g}", cure)
    if brightest > _BRIGHTEST:
        raise InputError(name, "values in [0, 1]", f"a value of {brightest:g}", "divide by 255")
