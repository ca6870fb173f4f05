"""What a field is fitted to: pixels whose true depth is known, and the disparity measured there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.geometry.projection import disparity_of_depth
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.image.grey_levels import grey_levels
from directshape_torch.stereo_matching.disparity import match_disparity
from directshape_torch.stereo_matching.patch_alignment import refine_disparity

# A match farther from the truth is a wrong match or a hidden point, not a bias.
_LARGEST_DIFFERENCE_PX = 4.0
_POINTS_PER_FRAME = 30_000
_GRID = (16, 8)


@dataclass(frozen=True)
class KnownDepth:
    """Left pixels whose true depth is known.

    Attributes:
        uv_left: (P, 2) pixels, float64.
        depth_m: (P,) along the optical axis of the left camera.
    """

    uv_left: Tensor
    depth_m: Tensor


@dataclass(frozen=True)
class DisparityObservations:
    """Measured against true disparity at P left pixels.

    Attributes:
        uv_left: (P, 2) pixels, float64.
        bias_px: (P,) measured minus true disparity.
        vertical_px: (P,) measured minus predicted row in the right image; zero where it was not measured.
        depth_m: (P,) true depth.
    """

    uv_left: Tensor
    bias_px: Tensor
    vertical_px: Tensor
    depth_m: Tensor

    def __len__(self) -> int:
        return len(self.bias_px)


def concatenate(parts: Sequence[DisparityObservations]) -> DisparityObservations:
    """The observations of several frames as one; none at all gives an empty one."""
    empty = torch.zeros(0, dtype=torch.float64)
    return DisparityObservations(
        torch.cat([empty.reshape(0, 2), *(part.uv_left for part in parts)]),
        torch.cat([empty, *(part.bias_px for part in parts)]),
        torch.cat([empty, *(part.vertical_px for part in parts)]),
        torch.cat([empty, *(part.depth_m for part in parts)]),
    )


def observe_disparity(
    image_left: NDArray[np.uint8],  # (H, W, 3) RGB
    image_right: NDArray[np.uint8],  # (H, W, 3)
    camera: StereoCamera,  # one frame; its disparity field is not used
    known: KnownDepth,
) -> DisparityObservations:
    """Measure the disparity at pixels of known depth: semi-global matching, then alignment of small patches.

    Args:
        image_left, image_right: rectified pair.
        camera: calibration of the frame.
        known: at most 30 000 of them are used, evenly over the image.

    Returns:
        the observations where both methods found the point; deterministic.
    """
    matched = torch.from_numpy(match_disparity(image_left, image_right)).double()
    height, width = matched.shape
    calibration = tuple(t[0].double() for t in (camera.K_left, camera.K_right, camera.T_right_cam))
    displacement = disparity_of_depth(known.uv_left, known.depth_m, *calibration)
    column = known.uv_left[:, 0].round().long().clamp(0, width - 1)
    row = known.uv_left[:, 1].round().long().clamp(0, height - 1)
    measured = matched[row, column]
    # Comparisons with NaN are false, so unmatched pixels drop out here.
    usable = torch.nonzero((measured - displacement[:, 0]).abs() < _LARGEST_DIFFERENCE_PX)[:, 0]
    chosen = usable[_evenly(known.uv_left[usable], (width, height), _POINTS_PER_FRAME)]
    uv, true, measured = known.uv_left[chosen], displacement[chosen], measured[chosen]
    # The semi-global disparity leans towards whole pixels.
    left, right = (_grey(image) for image in (image_left, image_right))
    measured, row_shift, keep = refine_disparity(left, right, uv, measured, true[:, 1])
    keep = keep & ((measured - true[:, 0]).abs() < _LARGEST_DIFFERENCE_PX)
    bias, vertical = measured - true[:, 0], true[:, 1] - row_shift
    return DisparityObservations(uv[keep], bias[keep], vertical[keep], known.depth_m[chosen][keep])


def matched_pixels(
    image_left: NDArray[np.uint8],  # (H, W, 3) RGB
    image_right: NDArray[np.uint8],  # (H, W, 3)
    uv_left: Tensor,  # (P, 2) whole pixels, float64
    matched: Tensor,  # (H, W) start, pixels
) -> tuple[Tensor, Tensor, Tensor]:
    """Those of the pixels whose patches could be aligned: (Q, 2), their disparity (Q,) and row shift (Q,)."""
    left, right = (_grey(image) for image in (image_left, image_right))
    start = matched[uv_left[:, 1].long(), uv_left[:, 0].long()]
    disparity, row_shift, reliable = refine_disparity(left, right, uv_left, start, torch.zeros_like(start))
    return uv_left[reliable], disparity[reliable], row_shift[reliable]


def cell_index(
    uv: Tensor,  # (P, 2)
    size_wh: tuple[int, int],
    grid: tuple[int, int],
) -> Tensor:  # (P,)
    """Number of the image cell of each pixel, row by row, in a grid of columns x rows."""
    column = (uv[:, 0] * grid[0] / size_wh[0]).long().clamp(0, grid[0] - 1)
    row = (uv[:, 1] * grid[1] / size_wh[1]).long().clamp(0, grid[1] - 1)
    return row * grid[0] + column


def _grey(image: NDArray[np.uint8]) -> Tensor:
    rgb = torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1).double() / 255
    return grey_levels(rgb[None])[0]


def _evenly(uv: Tensor, size_wh: tuple[int, int], count: int) -> Tensor:
    """At most `count` of the pixels, thinning full cells first; in their order."""
    if len(uv) <= count:
        return torch.arange(len(uv))
    shuffled = torch.randperm(len(uv), generator=torch.Generator().manual_seed(0))
    cell = cell_index(uv[shuffled], size_wh, _GRID)
    by_cell = torch.argsort(cell, stable=True)
    start = torch.searchsorted(cell[by_cell], cell[by_cell])
    rank_in_cell = torch.arange(len(uv)) - start
    first = torch.argsort(rank_in_cell, stable=True)[:count]
    return shuffled[by_cell[first]].sort().values
