"""Measured against true disparity at pixels whose depth is known: by disparity maps or LiDAR, in KITTI's layout."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.geometry.projection import project
from directshape_torch.io.image_files import find_image, read_disparity, read_pair
from directshape_torch.io.kitti_calibration import KittiCalibration, read_calibration, to_stereo_camera
from directshape_torch.io.velodyne import read_scan
from directshape_torch.rig.estimate import RigEstimate, rig_among
from directshape_torch.rig.pixels import cell_index, pixel_evidence
from directshape_torch.rig.rig import Rig
from directshape_torch.stereo_matching.patch_alignment import MatchedPair

TruthSource = Literal["disparity", "lidar"]
Frame = tuple[Rig, Tensor]  # and observations (P, 4), see `observe_disparity`

# A match farther from the truth is a wrong match or a hidden point, not a bias.
_LARGEST_DIFFERENCE_PX = 4.0
_POINTS_PER_FRAME = 30_000
_GRID = (16, 8)
_DEPTH_RANGE_M = (3.0, 80.0)
# The scanner stands higher than the camera and looks over things. A point is hidden where a neighbour within this many
# pixels is nearer by this much disparity; on a level road five rows are 1.6 px.
_WINDOW_PX = 5
_HIDDEN_BY_PX = 2.5


def truth_files(root: Path, source: TruthSource) -> dict[str, Path]:
    """The files of a source by frame id; of a stereo pair 2015 the first image (`NNNNNN_10`) keeps its full name.

    Raises:
        DataFormatError: there is no `root/training` or no file of that kind in it.
    """
    training = root / "training"
    if not training.is_dir():
        raise DataFormatError(root, "holds no folder 'training'", cure="give the folder above it, in KITTI's layout")
    patterns = ("disp_noc_0/*.png", "disp_occ_0/*.png") if source == "disparity" else ("velodyne/*.bin",)
    files = {path.stem: path for pattern in patterns for path in sorted(training.glob(pattern))}
    if not files:
        wanted = " or ".join(f"training/{pattern}" for pattern in patterns)
        cure = f"choose one of --from {', '.join(get_args(TruthSource))}"
        raise DataFormatError(root, f"holds no {wanted}", cure=cure)
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


def observe_frame(root: Path, frame_id: str, truth: Path, source: TruthSource) -> Frame:
    """Read one frame and measure its disparities where the truth is known.

    Raises:
        DataFormatError: a file is missing or damaged.
    """
    training = root / "training"
    calibration = read_calibration(training / "calib" / f"{frame_id}.txt")
    left, right = read_pair(*(find_image(training / name, frame_id) for name in ("image_2", "image_3")))
    rig = Rig.of(to_stereo_camera([calibration], dtype=torch.float64), (left.shape[1], left.shape[0]))
    known = _of_map(truth, rig) if source == "disparity" else known_depth_from_lidar(truth, calibration, rig)
    return rig, observe_disparity(MatchedPair.of(left, right), rig, known)


def add_truth(rigs: list[RigEstimate], source: TruthSource, frames: Sequence[Frame]) -> None:
    """The evidence of observed frames to the estimates of their rigs; new rigs join the list.

    Raises:
        InputError: fewer than 50 pixels of known and measured disparity for one of the rigs.
    """
    of_rig: dict[RigEstimate, list[Frame]] = {}
    for frame in frames:
        of_rig.setdefault(rig_among(rigs, frame[0]), []).append(frame)
    for estimate, seen in of_rig.items():
        observations = torch.cat([observed for _, observed in seen])
        estimate.add_pixels(source, pixel_evidence(observations, seen[0][0].size_wh, len(seen)))


def observe_disparity(
    pair: MatchedPair,
    rig: Rig,
    known: Tensor,  # (P, 3) u, v, depth
) -> Tensor:
    """Measure the disparity at pixels of known depth: semi-global matching, then alignment of small patches.

    Args:
        pair: the images.
        rig: their calibration.
        known: pixels and metres; at most 30 000 of them are used, evenly over the image.

    Returns:
        (Q, 4) u, v, measured minus true disparity, measured minus true row in the right image, where both methods
        found the point; deterministic.
    """
    uv, displacement = known[:, :2], rig.displacement(known[:, :2], known[:, 2])
    last = torch.tensor(rig.size_wh) - 1
    column, row = torch.minimum(uv.round().long().clamp_min(0), last).unbind(dim=1)
    measured = pair.matched[row, column]
    # Comparisons with NaN are false, so unmatched pixels drop out here.
    usable = torch.nonzero((measured - displacement[:, 0]).abs() < _LARGEST_DIFFERENCE_PX)[:, 0]
    chosen = usable[_evenly(uv[usable], rig.size_wh, _POINTS_PER_FRAME)]
    uv, true = uv[chosen], displacement[chosen]
    # The semi-global disparity leans towards whole pixels.
    found = pair.aligned(uv, measured[chosen], true[:, 1])
    offset = torch.stack([found.disparity - true[:, 0], true[:, 1] - found.row_shift], dim=1)
    keep = found.reliable & (offset[:, 0].abs() < _LARGEST_DIFFERENCE_PX)
    return torch.cat([uv, offset], dim=1)[keep]


def known_depth_from_lidar(path: Path, calibration: KittiCalibration, rig: Rig) -> Tensor:
    """Scan points (P, 3) u, v, depth that fall into the left image and are not hidden from the camera.

    Raises:
        DataFormatError: see `read_scan`.
    """
    points_cam = read_scan(path, calibration, to_stereo_camera([calibration], dtype=torch.float64))
    points_cam = points_cam[(points_cam[:, 2] > _DEPTH_RANGE_M[0]) & (points_cam[:, 2] < _DEPTH_RANGE_M[1])]
    known = torch.cat([project(points_cam, rig.K_left), points_cam[:, 2:]], dim=1)
    limit = torch.tensor(rig.size_wh, dtype=torch.float64) - 1
    known = known[((known[:, :2] >= 0) & (known[:, :2] <= limit)).all(dim=-1)]
    return known[~_hidden(known[:, :2], rig.displacement(known[:, :2], known[:, 2])[:, 0], rig.size_wh)]


def _of_map(path: Path, rig: Rig) -> Tensor:
    """Pixels (P, 3) u, v, depth whose true disparity is known."""
    disparity = torch.from_numpy(read_disparity(path, (rig.size_wh[1], rig.size_wh[0]))).double()
    v, u = torch.nonzero(disparity.isfinite(), as_tuple=True)
    uv = torch.stack([u, v], dim=-1).double()
    known = torch.cat([uv, rig.depth(uv, disparity[v, u])[:, None]], dim=1)
    return known[known[:, 2].isfinite()]


def _hidden(
    uv: Tensor,  # (P, 2)
    disparity: Tensor,  # (P,)
    size_wh: tuple[int, int],
) -> Tensor:  # (P,) bool
    """Whether a much nearer point lies close by in the image."""
    import cv2

    column, row = uv[:, 0].round().long().numpy(), uv[:, 1].round().long().numpy()
    nearest: NDArray[np.float32] = np.zeros((size_wh[1], size_wh[0]), np.float32)
    np.maximum.at(nearest, (row, column), disparity.numpy().astype(np.float32))
    kernel = np.ones((2 * _WINDOW_PX + 1, 2 * _WINDOW_PX + 1), np.uint8)
    around = np.asarray(cv2.dilate(nearest, kernel))[row, column]
    return torch.from_numpy(around).double() > disparity + _HIDDEN_BY_PX


def _evenly(uv: Tensor, size_wh: tuple[int, int], count: int) -> Tensor:
    """At most `count` of the pixels, thinning full cells first; in their order."""
    if len(uv) <= count:
        return torch.arange(len(uv))
    shuffled = torch.randperm(len(uv), generator=torch.Generator().manual_seed(0))
    cell = cell_index(uv[shuffled], size_wh, _GRID)
    by_cell = torch.argsort(cell, stable=True)
    rank_in_cell = torch.arange(len(uv)) - torch.searchsorted(cell[by_cell], cell[by_cell])
    first = torch.argsort(rank_in_cell, stable=True)[:count]
    return shuffled[by_cell[first]].sort().values
