"""Disparity maps of whole frames by the matcher that the settings name, where the frames bring none."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.scene import FrameBatch
from directshape_torch.stereo_matching.disparity import match_disparity
from directshape_torch.stereo_matching.elas import match_disparity_elas


def with_disparity(frames: FrameBatch, matcher: Literal["sgbm", "elas"], needed: Tensor | None = None) -> FrameBatch:
    """The frames with the disparity that they bring, or else with that of the matcher.

    Args:
        frames: F frames; the images pass through the CPU as 8-bit images.
        matcher: "sgbm" (OpenCV's semi-global matching) or "elas" (libelas, an optional package).
        needed: numbers of the frames to match, in any order and number; the others get NaN. None: all.

    Raises:
        MissingDependencyError: "elas" without its package.

    Example:
        >>> from directshape_torch.scene import GroundPlane, StereoCamera
        >>> K = torch.tensor([[[700.0, 0, 40], [0, 700.0, 20], [0, 0, 1]]])
        >>> T_right_cam = torch.eye(4)[None].clone()
        >>> T_right_cam[0, 0, 3] = -0.5
        >>> camera = StereoCamera(K, K, T_right_cam, torch.zeros(1, 3))
        >>> left = torch.rand(1, 3, 40, 80, generator=torch.Generator().manual_seed(0))
        >>> right = left.roll(-4, dims=3)
        >>> ground = GroundPlane.from_camera_height(1.65)
        >>> frames = FrameBatch(left, right, torch.tensor([[40, 80]]), camera, ground, ("0",))
        >>> with_disparity(frames, "sgbm").disparity[0, 20, 40]
        tensor(4.)
    """
    if frames.disparity is not None:
        return frames
    match = match_disparity if matcher == "sgbm" else match_disparity_elas
    maps = torch.full_like(frames.images_left[:, 0], torch.nan)
    sizes = frames.sizes.tolist()
    for k in range(len(sizes)) if needed is None else sorted(set(needed.tolist())):
        height, width = sizes[k]
        pair = (_rgb8(images[k, :, :height, :width]) for images in (frames.images_left, frames.images_right))
        maps[k, :height, :width] = torch.from_numpy(match(*pair)).to(maps)
    return replace(frames, disparity=maps)


def _rgb8(image: Tensor) -> NDArray[np.uint8]:
    """(H, W, 3) of 0..255 from (3, H, W) of [0, 1]; values that are not numbers become black."""
    levels = (image.detach().nan_to_num(nan=0.0) * 255).round().clamp(0, 255).to("cpu", torch.uint8)
    rgb: NDArray[np.uint8] = levels.permute(1, 2, 0).contiguous().numpy()
    return rgb
