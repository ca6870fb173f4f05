"""The box that the images and the detector give together, each counting by what it is known to be off by.

A refinement says where the images have a car, the detections of a run how far such results and their boxes lie apart
(`rig.detector_noise`). With the standard deviations of both the most probable box lies between them: a guess moves to
where the images have it, a LiDAR box stays. Derivation: docs/derivations/fusion.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, NamedTuple

import torch
from torch import Tensor

from directshape_torch.geometry import se3
from directshape_torch.geometry.box3d import rotation_y_from_pose, viewing_axes
from directshape_torch.numerics.records import CarRecord, Dense
from directshape_torch.numerics.tensors import constant_like
from directshape_torch.refinement.observability import HEADING_LEVER_M, quantities_jacobian
from directshape_torch.terms.cars import CarState, retract

if TYPE_CHECKING:
    from directshape_torch.refinement.result import RefinementResult
    from directshape_torch.scene import Detections


class ImageNoise(NamedTuple):
    """What images are off by in `CAR_QUANTITIES`: `sqrt((factor * sigma)^2 + floor^2)`, sigma uncalibrated."""

    factors: tuple[float, ...]  # 7
    floors_m: tuple[float, ...]  # 7


IMAGE_NOISE = ImageNoise((0.47, 0.0, 0.18, 2.16, 1.17, 0.34, 0.10), (0.136, 0.076, 0.060, 0.042, 0.219, 0.076, 0.053))
"""Fitted to labels of KITTI: the row "without rendered" of scripts/calibrate_fusion.py."""

_RIDGE = 1e-9


@dataclass(frozen=True)
class DetectorComparison(CarRecord):
    """Where B refined cars have their box and where the detector had it, columns `CAR_QUANTITIES`, metres.

    There are NaN for cars that were not refined, and for those that share their shape with other views of a track.

    Attributes:
        distance: (B,) of the images' box along the ground, metres.
        difference: (B, 7) the detector's less the images'; headings modulo half a turn.
        sigma_images: (B, 7) standard deviations of what the images say.
        covariance: (B, 7, 7) of the returned box where both were brought together, else NaN.
    """

    distance: Annotated[Tensor, Dense("B")]
    difference: Annotated[Tensor, Dense("B", 7)]
    sigma_images: Annotated[Tensor, Dense("B", 7)]
    covariance: Annotated[Tensor, Dense("B", 7, 7)]

    def variances_xyz_yaw(
        self,
        location: Tensor,  # (B, 3) of the cars, for their viewing rays
    ) -> Tensor:  # (B, 4)
        """The variances of x, y, z (metres) and heading (radians) of boxes that were brought together, else NaN."""
        # The quantities are depth and sideways position along the ground, and the height, which grows against y.
        axes = viewing_axes(location.detach().to(self.covariance))
        position = (axes.mT @ self.covariance[:, :3, :3] @ axes).diagonal(dim1=1, dim2=2)
        return torch.cat([position, self.covariance[:, 3, 3:4] / HEADING_LEVER_M**2], dim=1)


def fused(
    result: RefinementResult,
    detections: Detections,
    detector_sigmas: Tensor | None,
    image_noise: ImageNoise = IMAGE_NOISE,
) -> RefinementResult:
    """The result with the comparison of every refined car, and with the boxes that both sources give together.

    Args:
        result: of the images, B cars.
        detections: of the same cars.
        detector_sigmas: (7,) standard deviations of the detector in `CAR_QUANTITIES`: of the depth as a share of the
            distance, the others in metres. None: nothing is known, and the images' boxes stay.
        image_noise: what the images are off by.
    """
    known = result.refined & result.covariance.isfinite().flatten(1).all(dim=1) & (result.track_part < 0)
    rows = known.nonzero()[:, 0]
    if not result.has_shape or not len(rows):
        return result
    with torch.no_grad():
        J = quantities_jacobian(result.prior, _state(result, rows))
        factors, floors = (constant_like(x, J) for x in image_noise)
        of_images = factors[:, None] * (J @ result.covariance[rows] @ J.mT) * factors + torch.diag(floors**2)
    difference, origin = _difference(result, rows, detections), result.T_cam_obj.detach()[rows, :3, 3].to(J)
    distance, unknown = torch.hypot(origin[:, 0], origin[:, 2]), torch.full_like(of_images, torch.nan)
    sigma_images = of_images.diagonal(dim1=1, dim2=2).sqrt()
    comparison = DetectorComparison(distance, difference.detach(), sigma_images, unknown)
    if detector_sigmas is not None:
        sigmas = detector_sigmas.to(origin).repeat(len(rows), 1)
        # The depth's is a share of where the detector has the car.
        at_detector = detections.T_cam_obj.detach()[rows, :3, 3].to(origin)
        sigmas[:, 0] = sigmas[:, 0] * torch.hypot(at_detector[:, 0], at_detector[:, 2])
        of_detector = torch.diag_embed(sigmas**2)
        # Both are symmetric, so that the gain is the transpose of what solves for the covariance.
        gain = torch.linalg.solve_ex(of_images + of_detector, of_images)[0].mT
        comparison = replace(comparison, covariance=gain @ of_detector)
        result = _moved(result, rows, detections, J, (gain @ difference[..., None])[..., 0], difference)
    return replace(result, comparison=result.comparison.put(rows, comparison))


def _moved(
    result: RefinementResult, rows: Tensor, detections: Detections, J: Tensor, target: Tensor, difference: Tensor
) -> RefinementResult:
    """The result with the cars `rows` moved by a change (R, 7) of their quantities, towards the detector.

    The first step is linear, which sizes in the code are not; the second one takes what is left.
    """
    first = retract(_state(result, rows), _least_step(J, target))
    at = _at(result, rows, first)
    left = target - (difference - _difference(at, rows, detections))
    return _at(result, rows, retract(first, _least_step(J, left)))


def _least_step(J: Tensor, change: Tensor) -> Tensor:
    """The least step (R, D) of the tangent of `retract` that changes the quantities by so much (R, 7).

    The pose changes place and heading; the shape, whose unit is its own standard deviation, changes the sizes.
    """

    def solved(J: Tensor, change: Tensor) -> Tensor:
        ridge = _RIDGE * torch.eye(J.shape[1], dtype=J.dtype, device=J.device)
        step: Tensor = (J.mT @ torch.linalg.solve_ex(J @ J.mT + ridge, change[..., None])[0])[..., 0]
        return step

    return torch.cat([solved(J[:, :4, :6], change[:, :4]), solved(J[:, 4:, 6:], change[:, 4:])], dim=1)


def _state(result: RefinementResult, rows: Tensor) -> CarState:
    return CarState.of(se3.inverse(result.T_cam_obj[rows]), result.code[rows])


def _at(result: RefinementResult, rows: Tensor, state: CarState) -> RefinementResult:
    T_cam_obj = result.T_cam_obj.index_copy(0, rows, se3.inverse(state.T_obj_cam))
    return replace(result, T_cam_obj=T_cam_obj, code=result.code.index_copy(0, rows, state.code))


def _difference(result: RefinementResult, rows: Tensor, detections: Detections) -> Tensor:
    """The boxes of the detector less those of the result, (R, 7) in `CAR_QUANTITIES`, float64."""
    T_detector, boxes = detections.T_cam_obj[rows], result.rows(rows).to_boxes("kitti")
    moved = T_detector[:, :3, 3] - boxes[:, :3]
    axes = viewing_axes(result.T_cam_obj[rows, :3, 3].detach())
    along, across, down = (axes @ moved[..., None])[..., 0].unbind(dim=1)
    turned = rotation_y_from_pose(T_detector) - boxes[:, 6]
    # Modulo half a turn: what of a car is its front the detector says alone.
    heading = 0.5 * torch.atan2(torch.sin(2 * turned), torch.cos(2 * turned))
    height, width, length = (detections.dimensions_hwl[rows] - boxes[:, 3:6]).unbind(dim=1)
    return torch.stack([along, across, -down, HEADING_LEVER_M * heading, length, width, height], dim=1).double()
