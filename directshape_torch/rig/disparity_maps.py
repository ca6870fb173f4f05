"""True depth from ground-truth disparity maps (KITTI Stereo 2015: `disp_occ_0` or `disp_noc_0`)."""

from __future__ import annotations

from pathlib import Path

import torch

from directshape_torch.errors import DataFormatError
from directshape_torch.geometry.camera import depth_from_disparity
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.io.image_files import read_single_channel
from directshape_torch.rig.disparity_observations import KnownDepth

FOLDERS = ("disp_noc_0", "disp_occ_0")


def known_depth_from_disparity_map(
    path: Path,
    size_wh: tuple[int, int],
    camera: StereoCamera,  # one frame
) -> KnownDepth:
    """Pixels of a 16-bit PNG that holds disparity times 256, 0 where unknown.

    Raises:
        DataFormatError: no 16-bit image, of another size than the left image, or without a single disparity.
    """
    stored = read_single_channel(path)
    if stored.dtype != "uint16":
        raise DataFormatError(path, f"expected 16 bits (disparity times 256), got {stored.dtype}")
    if stored.shape != (size_wh[1], size_wh[0]):
        raise DataFormatError(
            path, f"has {stored.shape[1]} x {stored.shape[0]} pixels, the image {size_wh[0]} x {size_wh[1]}"
        )
    disparity = torch.from_numpy(stored.astype("float64")) / 256
    v, u = torch.nonzero(disparity, as_tuple=True)
    if len(u) == 0:
        raise DataFormatError(path, "holds no disparity, every pixel is 0")
    uv = torch.stack([u, v], dim=-1).double()
    K_left, K_right, T_right_cam = (t[0].double() for t in (camera.K_left, camera.K_right, camera.T_right_cam))
    depth = depth_from_disparity(uv, disparity[v, u], K_left, K_right, T_right_cam)
    valid = depth.isfinite()
    return KnownDepth(uv[valid], depth[valid])
