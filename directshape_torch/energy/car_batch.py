"""What the terms know of each car beside its pixels: cameras, ground, detector's box. Fixed for a whole refinement."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from directshape_torch.scene import Detections, FrameBatch


@dataclass(frozen=True)
class CarBatch:
    """Per-car constants of B cars.

    Attributes:
        detection_row: (B,) row of each car among the detections of the call.
        frame_index: (B,) frame of each car.
        input_depth: (B,) metres.
        K_right: (B, 3, 3).
        T_right_cam: (B, 4, 4).
        K_left: (B, 3, 3).
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

    def of_objects(self, keep: Tensor) -> CarBatch:
        known = {x.name: getattr(self, x.name) for x in fields(self) if getattr(self, x.name) is not None}
        # Found once: each look at a mask lets the host wait for the device.
        index = keep.nonzero()[:, 0]
        return replace(self, **{name: values.index_select(0, index) for name, values in known.items()})
