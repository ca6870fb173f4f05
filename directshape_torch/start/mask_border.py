"""This module tells, by the disparities beside a mask, whether it ends where a car ends, and whether it shows a thing.

A mask that lies anywhere has surroundings of its own disparities. The first and the last column of a car's mask are
ends of the car where neither the image nor a nearer object cuts it off.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from directshape_torch.geometry.stereo_depth import points_from_disparity
from directshape_torch.scene.frames import FrameBatch
from directshape_torch.scene.masks import MASK_THRESHOLD, MaskCrops
from directshape_torch.start.mask_points import depth_noise, height_above_ground, nearest_depth, rows_of_height

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
# The mask is cut off where it comes this near to the border of the image.
_BORDER_PX = 2
# What stands beside a mask is looked at in this many rows and at these distances from its outer columns.
_NUM_ROWS, _BESIDE_PX = 12, (3, 6)
# It hides an end of the car where this share of the rows shows something that is nearer than nearly all points of the
# car, and so high above the road that it is not the road.
_HIDING_SHARE, _LEAST_HEIGHT_M = 0.2, 0.3
# Where depths are as uncertain as half the width of a car, columns tell more of its place, even if they may be hidden.
_LARGEST_NOISE_M = 0.8


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
    import cv2

    # This takes a small part of the time of a maximum over windows of tensors.
    square = np.ones((2 * reach_px + 1, 2 * reach_px + 1), np.uint8)
    return torch.from_numpy(cv2.dilate(mask.byte().cpu().numpy(), square)).to(mask.device) > 0


def ends_seen(
    frames: FrameBatch,  # with disparity
    masks: MaskCrops,  # M masks of the left images
    frame_index: Tensor,  # (M,)
    points_cam: Tensor,  # (M, P, 3) points of the cars, NaN for none
) -> Tensor:
    """Whether (M, 2) the outer columns of masks are ends of cars, and not cut off by the image or a nearer object."""
    columns, width = masks.extents[:, 0::2], frames.sizes[frame_index, 1:]
    is_inside = torch.cat([columns[:, :1] > _BORDER_PX, columns[:, 1:] < width - _BORDER_PX], dim=1)
    nearest = nearest_depth(points_cam)
    noise = depth_noise(frames, frame_index, nearest)
    # Nothing of a car is below the row at which its nearest end stands on the road.
    points, is_own = _beside(frames, masks, frame_index, rows_of_height(frames, frame_index, points_cam, 0.0))
    above = height_above_ground(points.flatten(1, 3), frames, frame_index).view(is_own.shape)
    is_nearer = points[..., 2] < (nearest - noise)[:, None, None, None]
    hides = (is_nearer & ~is_own & (above > _LEAST_HEIGHT_M)).any(dim=3).to(noise).mean(dim=2) > _HIDING_SHARE
    return is_inside & ~(hides & (noise < _LARGEST_NOISE_M)[:, None])


def _beside(frames: FrameBatch, masks: MaskCrops, frame_index: Tensor, last_row: Tensor) -> tuple[Tensor, Tensor]:
    """Points (M, 2, rows, distances, 3) to the left and right of masks, and whether these are under the masks."""
    assert frames.disparity is not None, "the frames have no disparity"
    height, width = frames.disparity.shape[1:]
    (u0, _, u1, _), first = masks.extents.mT, masks.extents[:, 1].to(last_row)
    share = torch.linspace(0, 1, _NUM_ROWS, dtype=last_row.dtype, device=last_row.device)
    v = first[:, None] + share * (last_row.nan_to_num().clamp(first, first.new_tensor(height - 1)) - first)[:, None]
    beside = masks.extents.new_tensor(_BESIDE_PX)
    u = torch.stack([u0[:, None] - beside, u1[:, None] - 1 + beside], dim=1).clamp(0, width - 1)
    shape = len(u), 2, _NUM_ROWS, len(_BESIDE_PX)
    u, v = u[:, :, None].expand(shape), v[:, None, :, None].long().expand(shape)
    row = torch.arange(len(u), device=u.device)[:, None, None, None].expand_as(u)
    uv, f, camera = torch.stack([u, v], dim=-1).to(last_row), frame_index[row], frames.camera
    of_camera = camera.K_left[f], camera.K_right[f], camera.T_right_cam[f]
    points = points_from_disparity(uv, frames.disparity[f, v, u], *of_camera, camera.disparity_field)
    return points, masks.at(row, u, v) > MASK_THRESHOLD
