"""True depth from ground-truth disparity maps (KITTI Stereo 2015: `disp_occ_0` or `disp_noc_0`)."""

from __future__ import annotations

from pathlib import Path

import torch

from directshape_torch.geometry.projection import depth_from_disparity
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.io.image_files import read_disparity
from directshape_torch.rig.disparity_observations import KnownDepth

FOLDERS = ("disp_noc_0", "disp_occ_0")


def known_depth_from_disparity_map(
    path: Path,
    size_wh: tuple[int, int],
    camera: StereoCamera,  # one frame
) -> KnownDepth:
    """The pixels whose true disparity is known.

    Raises:
        DataFormatError: no disparity map (see `read_disparity`), or of another size than the left image.
    """
    disparity = torch.from_numpy(read_disparity(path, (size_wh[1], size_wh[0]))).double()
    v, u = torch.nonzero(disparity.isfinite(), as_tuple=True)
    uv = torch.stack([u, v], dim=-1).double()
    K_left, K_right, T_right_cam = (t[0].double() for t in (camera.K_left, camera.K_right, camera.T_right_cam))
    depth = depth_from_disparity(uv, disparity[v, u], K_left, K_right, T_right_cam)
    valid = depth.isfinite()
    return KnownDepth(uv[valid], depth[valid])
