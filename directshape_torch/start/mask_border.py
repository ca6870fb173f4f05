"""This module tells masks that show a thing from masks that lie anywhere, by the disparities across their borders."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d, pad

from directshape_torch.scene.masks import MASK_THRESHOLD, MaskCrops

# Matched windows mix both sides of a border up to the first distance; the surroundings reach to the second, pixels.
_MIXED_PX, _AROUND_PX = 4, 12
# Pixels of the mask that have all of their neighbours up to this distance are inside.
_INSIDE_PX = 2
# Cars stand on the road, which goes on under them, so this lower share of a mask's height has no surroundings.
_ON_ROAD = 0.35
# Fewer known disparities on either side tell nothing.
_FEWEST = 20
# A surface goes on where disparities are within this many pixels of most of the mask's.
_SAME_PX, _MOST = 0.5, (0.1, 0.9)


def share_going_on(
    disparity: Tensor,  # (F, H, W) NaN or 0 where unknown
    masks: MaskCrops,  # M masks of the left images
    frame_index: Tensor,  # (M,)
) -> Tensor:  # (M,)
    """The share of the disparities beside and above each mask that are also those of the mask; NaN where unknown.

    A car stands before something else: the share is near 0, and a mask on a wall or on another car has a large one.
    """
    # The boxes of masks with gradients are whole images, so the extents say where a mask is.
    rows = zip(frame_index.tolist(), masks, masks.extents.tolist(), strict=True)
    shares = [_share(disparity[frame], mask > MASK_THRESHOLD, extent) for frame, mask, extent in rows]
    return torch.stack(shares) if shares else disparity.new_zeros(0)


def _share(disparity: Tensor, mask: Tensor, extent: list[int]) -> Tensor:
    """The share of one mask (H, W), whose pixels all lie in the extent."""
    (u0, v0, u1, v1), reach = extent, _AROUND_PX
    seen: Tensor = pad(disparity, (reach,) * 4, value=torch.nan)[v0 : v1 + 2 * reach, u0 : u1 + 2 * reach]
    covered = pad(mask[v0:v1, u0:u1], (reach,) * 4)
    inside = seen[~_grown(~covered, _INSIDE_PX)]
    around = _grown(covered, _AROUND_PX) & ~_grown(covered, _MIXED_PX)
    around[reach + round((1 - _ON_ROAD) * (v1 - v0)) :] = False
    # Zero is no disparity either: the padding of frames has it.
    within, beyond = (each[each > 0] for each in (inside, seen[around]))
    if min(len(within), len(beyond)) < _FEWEST:
        return disparity.new_tensor(torch.nan)
    ordered = within.sort().values
    low, high = (ordered[round(share * (len(ordered) - 1))] for share in _MOST)
    goes_on: Tensor = (beyond > low - _SAME_PX) & (beyond < high + _SAME_PX)
    return goes_on.to(disparity.dtype).mean()


def _grown(mask: Tensor, reach_px: int) -> Tensor:
    """The mask and all pixels up to a distance from it, along rows and columns."""
    covered: Tensor = max_pool2d(mask[None].to(torch.float32), 2 * reach_px + 1, 1, reach_px)[0]
    return covered > 0
