"""The cars of a refinement: their state, the one place where it is updated, and what never changes about them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.geometry import se3
from directshape_torch.numerics.records import Record
from directshape_torch.scene import Detections, FrameBatch


class CarState(NamedTuple):
    """Pose and shape of B cars, and what else is unknown of them: the tangent has these parts, in this order."""

    T_obj_cam: Tensor  # (B, 4, 4) left camera to object
    code: Tensor  # (B, K) standard deviations
    offset_px: Tensor  # (B, S) measured minus true disparity, full-resolution pixels; S is 1, or 0 where it is known
    path: Tensor  # (B, N) of its track on the ground, see `terms.motion`; N is 9, or 0 where there is none
    # (B, M, 4, 4) next view of its track to object, see `terms.next_view`; M is 1, or 0 where nobody looks there
    T_obj_next: Tensor

    @classmethod
    def of(cls, T_obj_cam: Tensor, code: Tensor, num_offsets: int = 0) -> CarState:
        """Cars of a pose (B, 4, 4) and a shape (B, K), where the rig's disparity is as it is calibrated."""
        # No view of the code: compiled functions take other strides for another form.
        offset_px, path = code.new_zeros(len(code), num_offsets), code.new_zeros(len(code), 0)
        return cls(T_obj_cam, code, offset_px, path, code.new_zeros(len(code), 0, 4, 4))

    @property
    def num_unknowns(self) -> int:
        """D = 6 + K + S + N + 6 M."""
        return 6 + self.code.shape[1] + self.offset_px.shape[1] + self.path.shape[1] + 6 * self.T_obj_next.shape[1]


def retract(state: CarState, delta: Tensor, max_code: float = torch.inf, max_angle: float = torch.inf) -> CarState:
    """`T_obj_cam <- exp(v, omega) T_obj_cam`, `code <- code + dcode`, bounded, what else there is likewise.

    Args:
        state: B cars.
        delta: (B, 6 + K + S + N + 6 M), `(v, omega, dcode, doffset, dpath, v_next, omega_next)` in metres, radians,
            standard deviations, pixels and the units of the path.
        max_code: largest magnitude of a code component.
        max_angle: no rotation is larger, radians (see `se3.exp`).

    Examples:
        >>> state = CarState.of(torch.eye(4)[None], torch.zeros(1, 2))
        >>> retract(state, torch.tensor([[1.0, 0, 0, 0, 0, 0, 0.5, 9.0]]), max_code=3.0).code
        tensor([[0.5000, 3.0000]])
    """
    has_next = state.T_obj_next.shape[1]
    sizes = [6, state.code.shape[1], state.offset_px.shape[1], state.path.shape[1], 6 * has_next]
    twist, code_step, offset_step, path_step, next_twist = delta.to(state.code.dtype).split_with_sizes(sizes, dim=1)
    T_obj_cam, T_obj_next = torch.bmm(se3.exp(twist, max_angle), state.T_obj_cam), state.T_obj_next
    if has_next:
        T_obj_next = torch.bmm(se3.exp(next_twist, max_angle), T_obj_next[:, 0])[:, None]
    code = (state.code + code_step).clamp(-max_code, max_code)
    return CarState(T_obj_cam, code, state.offset_px + offset_step, state.path + path_step, T_obj_next)


def move_by_disparity(state: CarState, focal_baseline: Tensor, offset_px: float | Tensor) -> CarState:
    """Cars moved along the viewing ray of their origin so that its disparity grows by `offset_px`, (B,) or one."""
    T_cam_obj = se3.inverse(state.T_obj_cam)
    origin = T_cam_obj[:, :3, 3]
    disparity = focal_baseline / origin[:, 2]
    scale = disparity / (disparity + offset_px).clamp_min(0.1)
    moved = se3.from_rotation_translation(T_cam_obj[:, :3, :3], origin * scale[:, None])
    return state._replace(T_obj_cam=se3.inverse(moved))


@dataclass(frozen=True)
class CarBatch(Record):
    """What the terms know of B cars beside their pixels; fixed for a whole refinement."""

    num_detections: int  # of the call, refused ones among them
    detection_row: Tensor  # (B,) row of each car among the detections of the call
    frame_index: Tensor  # (B,) frame of each car
    input_depth: Tensor  # (B,) metres
    K_left: Tensor  # (B, 3, 3)
    K_right: Tensor  # (B, 3, 3)
    T_right_cam: Tensor  # (B, 4, 4)
    ground_normal_cam: Tensor  # (B, 3)
    ground_offset: Tensor  # (B,)
    detector_hwl: Tensor  # (B, 3)
    detector_T_cam_obj: Tensor  # (B, 4, 4) input pose
    detector_pose_sigma: Tensor | None  # (B, 4) its standard deviations, see `Detections`, or None
    # (B,) standard deviation of the unknown offset of the disparity; None where no car has one
    offset_sigma_px: Tensor | None
    field_sigma_px: Tensor  # (B,) that of the rig's disparity field at the car; 0 where the offset is an unknown
    track_id: Tensor | None  # (B,) see `Detections`, or None
    time_s: Tensor | None = None  # (B,) of each car's frame, see `FrameBatch`, or None
    T_world_cam: Tensor | None = None  # (B, 4, 4) likewise
    # (B, 7) standard deviations of the detector's boxes in `CAR_QUANTITIES`, metres, with which results are brought
    # together; None where they are not
    detector_noise: Tensor | None = None

    @classmethod
    def from_scene(cls, frames: FrameBatch, detections: Detections, disparity_sigma_px: float = 0.0) -> CarBatch:
        """All cars of a call, with the rig's `disparity_sigma_px` where the detections bring no sigma of their own."""
        f, offset_sigma_px = detections.frame_index, detections.offset_sigma_px
        if offset_sigma_px is None:
            offset_sigma_px = (
                torch.full_like(detections.T_cam_obj[:, 0, 0], disparity_sigma_px) if disparity_sigma_px else None
            )
        elif not bool((offset_sigma_px > 0).any()):
            offset_sigma_px = None
        field_sigma_px = frames.camera.field_sigma_px(f, detections.T_cam_obj[:, :3, 3])
        if offset_sigma_px is not None:
            # The unknown offset stands for the field.
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
            field_sigma_px=field_sigma_px,
            track_id=detections.track_id,
            time_s=None if frames.time_s is None else frames.time_s[f],
            T_world_cam=None if frames.T_world_cam is None else frames.T_world_cam[f],
        )

    def __len__(self) -> int:
        return len(self.frame_index)

    @property
    def focal_over_depth(self) -> Tensor:
        """Focal length over INPUT depth (B,), pixels per metre.

        Zeta comes from the input depth for the whole call, for a zeta that follows the state would let a car lower its
        cost by moving. Divided when asked for, after cars without a depth were left out: no NaN in gradients.
        """
        return self.K_left[:, 0, 0] / self.input_depth

    @property
    def focal_baseline(self) -> Tensor:
        """Focal length times baseline (B,), pixel metres: disparity is this over depth."""
        return -self.K_left[:, 0, 0] * self.T_right_cam[:, 0, 3]

    @property
    def num_offsets(self) -> int:
        """S of the cars' states."""
        return 0 if self.offset_sigma_px is None else 1

    def inverse_depth_of_offset(self, offset_px: Tensor) -> Tensor:
        """What offsets (B, 1) of the disparity add to the inverse depth (B, 1), per metre; 0 where they are known."""
        assert self.offset_sigma_px is not None
        per_px = torch.where(self.offset_sigma_px > 0, 1 / self.focal_baseline, 0.0)
        return offset_px * per_px[:, None]

    def of_cars(self, keep: Tensor, numbers: Sequence[int] | None = None) -> CarBatch:
        """Those of the cars where `keep` (B,) holds: `numbers` of them, should the host know it, who waits if not."""
        index = keep.nonzero()[:, 0] if numbers is None else torch.nonzero_static(keep, size=len(numbers))[:, 0]
        return self.rows(index)
