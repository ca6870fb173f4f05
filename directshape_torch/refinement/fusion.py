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


IMAGE_NOISE = ImageNoise((0.5, 0.5, 0.1, 2.1, 1.2, 0.5, 0.0), (0.108, 0.076, 0.06, 0.052, 0.19, 0.067, 0.053))
"""Against labels of KITTI (scripts/calibrate_fusion.py)."""

# A first step is linear, and sizes are not; the second takes what is left.
_NUM_STEPS = 2
_RIDGE = 1e-9


@dataclass(frozen=True)
class DetectorComparison(CarRecord):
    """Where B refined cars have their box and where the detector had it, columns `CAR_QUANTITIES`, metres.

    Attributes:
        difference: (B, 7) the detector's less the images'; headings modulo half a turn.
        sigma_images: (B, 7) standard deviations of what the images say.
        covariance: (B, 7, 7) of the returned box where both were brought together, else NaN.
    """

    difference: Annotated[Tensor, Dense("B", 7)]
    sigma_images: Annotated[Tensor, Dense("B", 7)]
    covariance: Annotated[Tensor, Dense("B", 7, 7)]

    def variances_xyz_yaw(
        self,
        location: Tensor,  # (B, 3) of the cars, for their viewing rays
    ) -> Tensor:  # (B, 4)
        """Of x, y, z and the heading, squared metres and radians, of boxes that were brought together; else NaN."""
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
            distance, the others in metres. None: nothing is known, and the images' boxes stay. So do those of cars that
            share their shape with other views of a track.
        image_noise: what the images are off by.
    """
    known = result.refined & result.covariance.isfinite().flatten(1).all(dim=1)
    rows = known.nonzero()[:, 0]
    if not result.has_shape or not len(rows):
        return result
    images = _Images.of(result, rows, image_noise)
    with torch.no_grad():
        difference = _difference(result, rows, detections)
    comparison = DetectorComparison(
        difference.double(),
        images.covariance.diagonal(dim1=1, dim2=2).sqrt(),
        torch.full_like(images.covariance, torch.nan),
    )
    result = replace(result, comparison=result.comparison.put(rows, comparison))
    if detector_sigmas is None:
        return result
    alone = (result.track_part[rows] < 0).nonzero()[:, 0]
    return _moved(result, rows[alone], detections, images.rows(alone), detector_sigmas) if len(alone) else result


@dataclass(frozen=True)
class _Images(CarRecord):
    """What the images say of R cars."""

    J: Annotated[Tensor, Dense("R", 7, "D")]  # of the quantities by the tangent of `retract`
    covariance: Annotated[Tensor, Dense("R", 7, 7)]  # of the quantities, metres

    @classmethod
    def of(cls, result: RefinementResult, rows: Tensor, noise: ImageNoise) -> _Images:
        with torch.no_grad():
            J = quantities_jacobian(result.prior, _state(result, rows))
            factors, floors = (constant_like(x, J) for x in noise)
            uncalibrated = J @ result.covariance[rows] @ J.mT
        return cls(J, factors[:, None] * uncalibrated * factors + torch.diag(floors**2))

    def step(self, change: Tensor) -> Tensor:
        """The least step (R, D) of the tangent that changes the quantities by so much (R, 7).

        The pose changes place and heading; the shape, whose unit is its own standard deviation, changes the sizes.
        """
        of_pose, of_code = _least(self.J[:, :4, :6], change[:, :4]), _least(self.J[:, 4:, 6:], change[:, 4:])
        return torch.cat([of_pose, of_code], dim=1)


def _least(J: Tensor, change: Tensor) -> Tensor:
    """The smallest step (R, D) with `J step = change`."""
    products = J @ J.mT
    ridge = _RIDGE * torch.eye(J.shape[1], dtype=J.dtype, device=J.device)
    step: Tensor = (J.mT @ torch.linalg.solve_ex(products + ridge, change[..., None])[0])[..., 0]
    return step


def _moved(
    result: RefinementResult, rows: Tensor, detections: Detections, images: _Images, detector_sigmas: Tensor
) -> RefinementResult:
    """The result with the cars `rows` where images and detector have them together."""
    origin = detections.T_cam_obj.detach()[rows, :3, 3].double()
    sigmas = detector_sigmas.to(origin).repeat(len(rows), 1)
    sigmas[:, 0] = sigmas[:, 0] * torch.hypot(origin[:, 0], origin[:, 2])
    both = images.covariance + torch.diag_embed(sigmas**2)
    # Symmetric, so that the gain is the transpose of what solves for the covariance.
    gain = torch.linalg.solve_ex(both, images.covariance)[0].mT
    difference = _difference(result, rows, detections).double()
    target = (gain @ difference[..., None])[..., 0]
    state = _state(result, rows)
    for _ in range(_NUM_STEPS):
        at = _at(result, rows, state)
        done = difference - _difference(at, rows, detections).double()
        state = retract(state, images.step(target - done))
    posterior = gain @ torch.diag_embed(sigmas**2)
    comparison = result.comparison.rows(rows)
    return replace(
        _at(result, rows, state),
        comparison=result.comparison.put(rows, replace(comparison, covariance=posterior)),
    )


def _state(result: RefinementResult, rows: Tensor) -> CarState:
    return CarState.of(se3.inverse(result.T_cam_obj[rows]), result.code[rows])


def _at(result: RefinementResult, rows: Tensor, state: CarState) -> RefinementResult:
    T_cam_obj = result.T_cam_obj.index_copy(0, rows, se3.inverse(state.T_obj_cam))
    return replace(result, T_cam_obj=T_cam_obj, code=result.code.index_copy(0, rows, state.code))


def _difference(result: RefinementResult, rows: Tensor, detections: Detections) -> Tensor:
    """The boxes of the detector less those of the result, (R, 7) in `CAR_QUANTITIES`."""
    T_detector, boxes = detections.T_cam_obj[rows], result.rows(rows).to_boxes("kitti")
    moved = T_detector[:, :3, 3] - boxes[:, :3]
    axes = viewing_axes(result.T_cam_obj[rows, :3, 3].detach())
    along, across, down = (axes @ moved[..., None])[..., 0].unbind(dim=1)
    turned = rotation_y_from_pose(T_detector) - boxes[:, 6]
    # Modulo half a turn: what of a car is its front the detector says alone.
    heading = 0.5 * torch.atan2(torch.sin(2 * turned), torch.cos(2 * turned))
    height, width, length = (detections.dimensions_hwl[rows] - boxes[:, 3:6]).unbind(dim=1)
    return torch.stack([along, across, -down, HEADING_LEVER_M * heading, length, width, height], dim=1)
