"""What a refinement gives back for every car."""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Integral
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from directshape_torch.diagnosis.disparity_profile import DisparityProfile
from directshape_torch.diagnosis.observability import Observability
from directshape_torch.diagnosis.quality import FitQuality
from directshape_torch.diagnosis.trust_model import bundled_trust_model
from directshape_torch.errors import InputError, shown
from directshape_torch.geometry import se3
from directshape_torch.geometry.box3d import alpha_from_kitti, rotation_y_from_pose
from directshape_torch.shape.sdf_grid import zero_level_extents
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.status import Status, is_refined

if TYPE_CHECKING:
    import trimesh


@dataclass(frozen=True)
class KittiBoxes:
    """Boxes in KITTI's convention, measured on the refined zero level.

    Attributes:
        dimensions_hwl: (B, 3) height, width, length, metres.
        location_ref: (B, 3) bottom centre in the reference frame of labels, metres.
        rotation_y: (B,) radians.
        alpha: (B,) radians.
    """

    dimensions_hwl: Tensor
    location_ref: Tensor
    rotation_y: Tensor
    alpha: Tensor


@dataclass(frozen=True)
class RefinementResult:
    """Outcome of a refinement of B cars, in the order of the detections.

    Attributes:
        T_cam_obj: (B, 4, 4) refined poses; the input's where the status says so.
        code: (B, K) shape codes, standard deviations.
        status_code: (B,) integer, see `status`.
        iterations: (B,) Gauss-Newton iterations.
        term_names: names of the T terms.
        cost_before, cost_after: (B, T) cost of each term for input and output, both at the final stage; NaN for cars
            that were not refined at all. Those of `not_trusted` cars are of the refinement that was not returned.
        covariance: (B, 6 + K, 6 + K) in the tangent `(v, omega, dcode)` of the object frame; uncalibrated (relative).
            NaN for cars that were not refined.
        covariance_xyz_yaw: (B, 4, 4) of the object origin (x, y, z) in the reference frame and the heading, relative
            too; `sigma_xyz_yaw` is calibrated.
        cost_history: (B, n) cost after each iteration, NaN where a car took no part; not comparable across
            stages, each of which begins when the slowest car of the batch has ended the one before.
        quality: agreement of each refined car with masks and images.
        observability: what its view does not show; `observability.words()` says it in words.
        profile: photometric cost over the disparity at input and end; of `not_trusted` cars at the end that was not
            returned.
        input_dimensions_hwl: (B, 3) of the detections, metres.
        ground_source: where the ground plane of each car's frame came from, B entries.
        t_cam_ref: (B, 3) `x_cam = x_ref + t_cam_ref`.
        prior: the shapes.
        has_shape: the shape was refined, so that boxes are measured on it; False for the method "box_alignment".
    """

    T_cam_obj: Tensor
    code: Tensor
    status_code: Tensor
    iterations: Tensor
    term_names: tuple[str, ...]
    cost_before: Tensor
    cost_after: Tensor
    covariance: Tensor
    covariance_xyz_yaw: Tensor
    cost_history: Tensor
    quality: FitQuality
    observability: Observability
    profile: DisparityProfile
    input_dimensions_hwl: Tensor
    ground_source: tuple[str, ...]
    t_cam_ref: Tensor
    prior: ShapePrior
    has_shape: bool = True

    def __len__(self) -> int:
        return len(self.T_cam_obj)

    @property
    def status(self) -> list[Status]:
        """How each car ended; `status.value` is the message."""
        return [Status.from_code(code) for code in self.status_code.tolist()]

    @property
    def refined(self) -> Tensor:
        """(B,) bool: cars whose state is a refined one."""
        return is_refined(self.status_code)

    @property
    def T_ref_obj(self) -> Tensor:
        """Poses (B, 4, 4) in the reference frame of labels and result files."""
        shift = torch.zeros_like(self.T_cam_obj)
        shift[:, :3, 3] = self.t_cam_ref
        return self.T_cam_obj - shift

    def boxes(self) -> KittiBoxes:
        """KITTI boxes of the refined zero level, sub-voxel; the location is the level's own bottom centre.

        Cars that were not refined have the detector's box, boxes that were moved alone its dimensions.

        Location is `T_ref_obj` of (mid x, max y, mid z) of the level, not the object origin.
        """
        values = self.prior.values(self.code)
        extents = zero_level_extents(values, self.prior.origin, self.prior.spacing_m)
        lower, upper = extents.unbind(1)
        length, height, width = (upper - lower).unbind(-1)
        middle = 0.5 * (lower + upper)
        bottom_obj = torch.stack([middle[:, 0], upper[:, 1], middle[:, 2]], dim=-1)
        T_ref_obj = self.T_ref_obj
        location = se3.transform(T_ref_obj, bottom_obj)
        rotation_y = rotation_y_from_pose(T_ref_obj)
        dimensions = torch.stack([height, width, length], dim=-1)
        # A car whose shape was not refined keeps the detector's box, not one of the mean shape.
        refined = self.refined[:, None] & self.has_shape
        dimensions = torch.where(refined, dimensions, self.input_dimensions_hwl)
        location = torch.where(refined, location, T_ref_obj[:, :3, 3])
        return KittiBoxes(dimensions, location, rotation_y, alpha_from_kitti(location, rotation_y))

    @property
    def sigma_xyz_yaw(self) -> Tensor:
        """Calibrated standard deviations (B, 4) of the box's place in `ref` and of its heading, metres and radians.

        NaN for cars that were not refined. Calibrated with the default settings on rendered frames; a rig's own
        disparity error is in them as far as `rig.disparity_sigma_px` or `Detections.offset_sigma_px` says.
        """
        covariance = bundled_trust_model().calibrated_covariance(self.covariance_xyz_yaw, self.T_cam_obj[:, :3, 3])
        return covariance.diagonal(dim1=1, dim2=2).sqrt()

    def mesh(self, index: int) -> trimesh.Trimesh:
        """Surface of one car in the left camera frame, metres, outward normals.

        Raises:
            InputError: no such car.
        """
        if not (isinstance(index, Integral) and 0 <= index < len(self)):
            raise InputError(
                "index", f"a car of 0..{len(self) - 1}" if len(self) else "no car", f"{shown(index)}: {len(self)} cars"
            )
        from directshape_torch.shape.sdf_to_mesh import sdf_to_mesh

        values = self.prior.values(self.code[index : index + 1])[0]
        return sdf_to_mesh(values, self.prior.origin, self.prior.spacing_m, T_cam_obj=self.T_cam_obj[index])
