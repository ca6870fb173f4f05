"""This module defines the cars of a refinement: their state, and the constants that are known about them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from directshape_torch.numerics.records import Dense
from directshape_torch.numerics.tables import Table
from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import FrameBatch
from directshape_torch.state.unknowns import Unknowns, blocks_of_car


class CarState(NamedTuple):
    """A `CarState` is the `State` of B cars that are each refined alone."""

    T_obj_cam: Annotated[Tensor, Dense("B", 4, 4)]  # left camera to object
    code: Annotated[Tensor, Dense("B", "K")]  # standard deviations
    # measured minus true disparity, full-resolution pixels; S is 0 where the offset is known, else 1
    offset_px: Annotated[Tensor, Dense("B", "S")]

    @classmethod
    def of(cls, T_obj_cam: Tensor, code: Tensor, num_offsets: int = 0) -> CarState:
        """State of cars with poses (B, 4, 4), shapes (B, K) and offsets of zero."""
        return cls(T_obj_cam, code, code.new_zeros(len(code), num_offsets))

    @property
    def unknowns(self) -> Unknowns:
        """Blocks of the tangent `(v, omega, dcode, doffset)`.

        Examples:
            >>> state = CarState.of(torch.eye(4)[None], torch.zeros(1, 2))
            >>> step = torch.tensor([[1.0, 0, 0, 0, 0, 0, 0.5, 9.0]])
            >>> state.unknowns.retract(state, step, max_code=3.0).code
            tensor([[0.5000, 3.0000]])
        """
        return Unknowns(blocks_of_car(self.code.shape[1], self.offset_px.shape[1]))


@dataclass(frozen=True)
class CarBatch(Table):
    """A `CarBatch` holds what the terms know of B cars besides their pixels; it is fixed for a whole refinement."""

    num_detections: int  # number of detections of the call, including refused ones
    detection_row: Annotated[Tensor, Dense("B", kind="index")]  # row of each car among the detections of the call
    frame_index: Annotated[Tensor, Dense("B", kind="index")]  # frame of each car
    input_depth: Annotated[Tensor, Dense("B")]  # metres
    K_left: Annotated[Tensor, Dense("B", 3, 3)]
    K_right: Annotated[Tensor, Dense("B", 3, 3)]
    T_right_cam: Annotated[Tensor, Dense("B", 4, 4)]
    ground_normal_cam: Annotated[Tensor, Dense("B", 3)]
    ground_offset: Annotated[Tensor, Dense("B")]
    detector_hwl: Annotated[Tensor, Dense("B", 3)]
    detector_T_cam_obj: Annotated[Tensor, Dense("B", 4, 4)]  # input pose
    # standard deviations of the input pose, see `Detections`
    detector_pose_sigma: Annotated[Tensor | None, Dense("B", 4)]
    # standard deviation of the unknown offset of the disparity; None where no car has an unknown offset
    offset_sigma_px: Annotated[Tensor | None, Dense("B")]
    # change of the inverse depth, per metre, by a pixel of that offset; 0 where the offset is known
    inverse_depth_of_pixel: Annotated[Tensor | None, Dense("B", 1)]
    # standard deviation of the rig's disparity field at the car; 0 where the offset is an unknown
    field_sigma_px: Annotated[Tensor, Dense("B")]
    track_id: Annotated[Tensor | None, Dense("B", kind="index")]  # see `Detections`
    time_s: Annotated[Tensor | None, Dense("B")] = None  # time of each car's frame, see `FrameBatch`
    T_world_cam: Annotated[Tensor | None, Dense("B", 4, 4)] = None  # camera pose of each frame, see `FrameBatch`
    # standard deviations of the detector's boxes in `CAR_QUANTITIES`, metres, with which results are combined with
    # these boxes; None where results are not combined
    detector_noise: Annotated[Tensor | None, Dense("B", 7)] = None
    # whether no detector made the input box, see `Detections`; None where detectors made all boxes
    is_from_masks: Annotated[Tensor | None, Dense("B", kind="flags")] = None

    @classmethod
    def from_scene(cls, frames: FrameBatch, detections: Detections, disparity_sigma_px: float = 0.0) -> CarBatch:
        """All cars of a call; `disparity_sigma_px` of the rig is used where the detections have no sigma."""
        f, offset_sigma_px = detections.frame_index, detections.offset_sigma_px
        if offset_sigma_px is None:
            offset_sigma_px = (
                torch.full_like(detections.T_cam_obj[:, 0, 0], disparity_sigma_px) if disparity_sigma_px else None
            )
        elif not bool((offset_sigma_px > 0).any()):
            offset_sigma_px = None
        field_sigma_px = frames.camera.field_sigma_px(f, detections.T_cam_obj[:, :3, 3])
        inverse_depth_of_pixel = None
        if offset_sigma_px is not None:
            per_px = 1 / (frames.camera.K_left[f, 0, 0] * frames.camera.baseline[f])
            inverse_depth_of_pixel = torch.where(offset_sigma_px > 0, per_px, 0.0)[:, None]
            # An unknown offset already accounts for the error of the disparity field.
            field_sigma_px = field_sigma_px.masked_fill(offset_sigma_px > 0, 0.0)
        return cls(
            num_detections=len(f),
            detection_row=torch.arange(len(f), device=f.device),
            frame_index=f,
            input_depth=detections.T_cam_obj[:, 2, 3],
            K_left=frames.camera.K_left[f],
            K_right=frames.camera.K_right[f],
            T_right_cam=frames.camera.T_right_cam[f],
            ground_normal_cam=frames.ground.normal[f],
            ground_offset=frames.ground.offset[f],
            detector_hwl=detections.dimensions_hwl,
            detector_T_cam_obj=detections.T_cam_obj,
            detector_pose_sigma=detections.pose_sigma,
            offset_sigma_px=offset_sigma_px,
            inverse_depth_of_pixel=inverse_depth_of_pixel,
            field_sigma_px=field_sigma_px,
            track_id=detections.track_id,
            time_s=None if frames.time_s is None else frames.time_s[f],
            T_world_cam=None if frames.T_world_cam is None else frames.T_world_cam[f],
            is_from_masks=detections.is_from_masks,
        )

    def __len__(self) -> int:
        return len(self.frame_index)

    @property
    def focal_over_depth(self) -> Tensor:
        """Focal length over INPUT depth (B,), pixels per metre.

        Zeta comes from the input depth for the whole call, because a zeta that follows the state would let a car lower
        its cost by moving. The division happens here, after cars without a depth were removed, so that gradients have
        no NaN.
        """
        return self.K_left[:, 0, 0] / self.input_depth

    @property
    def focal_baseline(self) -> Tensor:
        """Focal length times baseline (B,), pixel metres; divided by a depth it gives a disparity."""
        return -self.K_left[:, 0, 0] * self.T_right_cam[:, 0, 3]

    @property
    def num_offsets(self) -> int:
        """Number S of unknown offsets in the state of a car, 0 or 1."""
        return 0 if self.offset_sigma_px is None else 1

    def inverse_depth_of_offset(self, offset_px: Tensor) -> Tensor:
        """Change of the inverse depth (B, 1), per metre, by offsets (B, 1) of the disparity; 0 where they are known."""
        assert self.inverse_depth_of_pixel is not None
        return offset_px * self.inverse_depth_of_pixel
