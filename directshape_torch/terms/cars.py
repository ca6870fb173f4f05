"""The cars of a refinement: their state, the one place where it is updated, and what never changes about them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.geometry import se3
from directshape_torch.scene import Detections, FrameBatch


class CarState(NamedTuple):
    """Pose and shape of B cars."""

    T_obj_cam: Tensor  # (B, 4, 4) left camera to object
    code: Tensor  # (B, K) standard deviations


def retract(state: CarState, delta: Tensor, max_code: float = torch.inf, max_angle: float = torch.inf) -> CarState:
    """`T_obj_cam <- exp(delta[:6]) T_obj_cam`, `code <- code + delta[6:]`, the code bounded.

    Args:
        state: B cars.
        delta: (B, 6 + K), `(v, omega, dcode)` in metres, radians and standard deviations.
        max_code: largest magnitude of a code component.
        max_angle: no rotation is larger, radians (see `se3.exp`).

    Example:
        >>> state = CarState(torch.eye(4)[None], torch.zeros(1, 2))
        >>> retract(state, torch.tensor([[1.0, 0, 0, 0, 0, 0, 0.5, 9.0]]), max_code=3.0).code
        tensor([[0.5000, 3.0000]])
    """
    twist, code_step = torch.split_with_sizes(delta.to(state.code.dtype), [6, delta.shape[1] - 6], dim=1)
    T_obj_cam = torch.bmm(se3.exp(twist, max_angle), state.T_obj_cam)
    return CarState(T_obj_cam, (state.code + code_step).clamp(-max_code, max_code))


@dataclass(frozen=True)
class CarBatch:
    """What the terms know of B cars beside their pixels; fixed for a whole refinement.

    Attributes:
        detection_row: (B,) row of each car among the detections of the call.
        frame_index: (B,) frame of each car.
        input_depth: (B,) metres.
        K_left: (B, 3, 3).
        K_right: (B, 3, 3).
        T_right_cam: (B, 4, 4).
        ground_normal_cam: (B, 3).
        ground_offset: (B,).
        detector_hwl: (B, 3).
        detector_T_cam_obj: (B, 4, 4) input pose.
        detector_pose_sigma: (B, 4) its standard deviations, see `Detections`, or None.
    """

    detection_row: Tensor
    frame_index: Tensor
    input_depth: Tensor
    K_left: Tensor
    K_right: Tensor
    T_right_cam: Tensor
    ground_normal_cam: Tensor
    ground_offset: Tensor
    detector_hwl: Tensor
    detector_T_cam_obj: Tensor
    detector_pose_sigma: Tensor | None

    @classmethod
    def from_scene(cls, frames: FrameBatch, detections: Detections) -> CarBatch:
        f = detections.frame_index
        return cls(
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

    def of_cars(self, keep: Tensor, numbers: Sequence[int] | None = None) -> CarBatch:
        """Those of the cars where `keep` (B,) holds: `numbers` of them, should the host know it, who waits if not."""
        known = {x.name: getattr(self, x.name) for x in fields(self) if getattr(self, x.name) is not None}
        index = keep.nonzero()[:, 0] if numbers is None else torch.nonzero_static(keep, size=len(numbers))[:, 0]
        return replace(self, **{name: values.index_select(0, index) for name, values in known.items()})
