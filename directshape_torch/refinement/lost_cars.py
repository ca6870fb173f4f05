"""This module makes boxes of the masks of cars to which the given boxes may not lead."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from directshape_torch.refinement.result import RefinementResult
from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import FrameBatch
from directshape_torch.start.from_masks import start_boxes
from directshape_torch.start.mask_border import share_going_on
from directshape_torch.start.mask_points import depth_noise
from directshape_torch.stereo_matching.disparity import with_disparity

# On their own images 95 % of the masks of rendered and kitti15 have a smaller share of surroundings that go on where
# they end (scripts/wrong_boxes.py).
LARGEST_SHARE_GOING_ON = 0.15
# A refinement moves a box by about this much.
_REACH_M, _REACH_RAD = 1.0, math.radians(20)


@torch.no_grad()
def boxes_of_lost_cars(
    frames: FrameBatch, detections: Detections, result: RefinementResult, lost: Tensor
) -> tuple[Detections, Tensor]:
    """The detections with boxes made of their masks for those cars (B,) that may be lost, and which cars these are.

    The other cars, which may hide these, stand where the result has them. A car is not lost if its mask shows no car
    that stands out, or if no box of its mask is out of the reach of its given box.
    """
    frames = with_disparity(frames, detections.frame_index[lost], detections.mask_left.extents[lost])
    lost = lost & _stands_out(frames, detections, lost)
    rows = lost.nonzero()[:, 0]
    if not len(rows):
        return detections, lost
    some = detections.rows(rows)
    made = start_boxes(frames, some.mask_left, some.mask_right, some.frame_index, some.score)
    # Each of the other cars gets the row of some lost car, and its own values below.
    everyone = made.rows((lost.cumsum(0) - 1).clamp_min(0))
    lost = lost.index_copy(0, rows, _is_out_of_reach(frames, made, some.T_cam_obj))
    everyone = replace(
        everyone,
        frame_index=detections.frame_index,
        T_cam_obj=torch.where(lost[:, None, None], everyone.T_cam_obj, result.T_cam_obj.detach()),
        dimensions_hwl=torch.where(lost[:, None], everyone.dimensions_hwl, detections.dimensions_hwl),
        box_2d=detections.box_2d,
        score=detections.score,
        mask_left=detections.mask_left,
        mask_right=detections.mask_right,
        occluders=detections.occluders,
        # The detector's standard deviations do not hold for these boxes, but the terms stay the same.
        pose_sigma=torch.full_like(detections.box_2d, torch.inf) if "pose" in result.term_names else None,
        offset_sigma_px=detections.offset_sigma_px,
    )
    return everyone, lost


def _is_out_of_reach(frames: FrameBatch, made: Detections, T_cam_obj: Tensor) -> Tensor:
    """Whether (B,) some pose of cars is farther from the given ones (B, 4, 4) than a refinement goes.

    Depths of stereo are off by more, the farther the car.
    """
    assert made.other_T_cam_obj is not None
    T_cam_start = torch.cat([made.T_cam_obj[:, None], made.other_T_cam_obj], dim=1)
    off_m = (T_cam_start[..., 0:3:2, 3] - T_cam_obj[:, None, 0:3:2, 3]).norm(dim=-1)
    cos_turned = (T_cam_start[..., :3, 0] * T_cam_obj[:, None, :3, 0]).sum(dim=-1).abs()
    is_far = off_m > _REACH_M + depth_noise(frames, made.frame_index, T_cam_start[..., 2, 3])
    # NaN, for a mask without a car, is not farther.
    is_elsewhere: Tensor = is_far | (cos_turned < math.cos(_REACH_RAD))
    return is_elsewhere.any(dim=1)


def _stands_out(frames: FrameBatch, detections: Detections, chosen: Tensor) -> Tensor:
    """Whether (B,) the masks of the chosen cars end where what they show ends."""
    assert frames.disparity is not None, "the frames have no disparity"
    rows = chosen.nonzero()[:, 0]
    some = detections.rows(rows)
    share = share_going_on(frames.disparity, some.mask_left, some.frame_index)
    return torch.zeros_like(chosen).index_copy(0, rows, share < LARGEST_SHARE_GOING_ON)  # NaN is not below
