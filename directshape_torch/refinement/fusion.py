"""This module combines the box of the images with the detector's box and weighs both by their known errors.

A refinement gives the box of a car in the images. The detections of a run show how far the refined boxes and the
detector's boxes are apart (`rig.detector_noise`). The standard deviations of both give the most probable box, which
lies between them: a rough guess moves to the box of the images, and a LiDAR box stays. The derivation is in
docs/derivations/fusion.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated

import torch
from torch import Tensor

from directshape_torch.geometry import se3
from directshape_torch.geometry.box3d import rotation_y_from_pose, viewing_axes
from directshape_torch.kernels.choice import array, takes_loops
from directshape_torch.numerics.records import CarRecord, Dense
from directshape_torch.refinement.observability import HEADING_LEVER_M, quantities_jacobian
from directshape_torch.refinement.trust import ImageNoise, probabilities
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.shape.zero_level import zero_level_extents
from directshape_torch.state.cars import CarBatch, CarState
from directshape_torch.state.unknowns import CODE, POSE, Unknowns

if TYPE_CHECKING:
    from directshape_torch.refinement.result import RefinementResult

UNKNOWN_DETECTOR = torch.tensor([0.0260, 0.1558, 0.0779, 0.2078, 0.70, 0.16, 0.16], dtype=torch.float64)
"""These are the standard deviations of a detector of which nothing is known.

`rig.detector_noise.detector_sigmas` gives them if it has no results.
"""

_RIDGE = 1e-9


@dataclass(frozen=True)
class DetectorComparison(CarRecord):
    """This compares the boxes of B refined cars with the detector's boxes, in columns `CAR_QUANTITIES`, metres.

    The figures are NaN for cars that were not refined. Only `distance_in_sigmas` is kept for refused results.

    Attributes:
        distance: (B,) distance of the images' box along the ground, metres.
        difference: (B, 7) the detector's box minus the images' box, with headings modulo half a turn. It is also NaN
            for views of a track and for boxes that no detector made.
        sigma_images: (B, 7) standard deviations of the images' box.
        gain: (B, 7, 7) `gain @ difference` is the most probable box minus the images' box. It is zero where boxes are
            not combined.
        covariance: (B, 7, 7) covariance of the most probable box. Views of a track return the images' box, so for them
            it is the covariance of that box.
        distance_in_sigmas: (B,) distance between both boxes in the standard deviations of both. It is about 2.6 if all
            seven quantities behave as expected, and NaN where boxes are not combined.
    """

    distance: Annotated[Tensor, Dense("B")]
    difference: Annotated[Tensor, Dense("B", 7)]
    sigma_images: Annotated[Tensor, Dense("B", 7)]
    gain: Annotated[Tensor, Dense("B", 7, 7)]
    covariance: Annotated[Tensor, Dense("B", 7, 7)]
    distance_in_sigmas: Annotated[Tensor, Dense("B")]


def noise_of_boxes(
    sigmas: Tensor,  # (7,) of `RigEstimate.detector_sigmas`
    T_cam_obj: Tensor,  # (B, 4, 4)
) -> Tensor:  # (B, 7)
    """Standard deviations of a detector's boxes in `CAR_QUANTITIES`, metres; depth errors grow with distance."""
    origin = T_cam_obj.detach()[:, :3, 3].double()
    units = torch.ones(len(origin), len(sigmas), dtype=origin.dtype, device=origin.device)
    units[:, 0] = torch.hypot(origin[:, 0], origin[:, 2])
    return sigmas.to(origin) * units


def level_boxes(
    prior: ShapePrior,
    T: Tensor,  # (B, 4, 4) object to any frame
    code: Tensor,  # (B, K)
) -> tuple[Tensor, Tensor]:  # (B, 3), (B, 3)
    """Bottom centres of the boxes around zero levels, in the target frame of `T`, and height, width, length."""
    lower, upper = _extents(prior, code).unbind(1)
    length, height, width = (upper - lower).unbind(-1)
    middle = 0.5 * (lower + upper)
    bottom_obj = torch.stack([middle[:, 0], upper[:, 1], middle[:, 2]], dim=-1)
    return se3.transform(T, bottom_obj), torch.stack([height, width, length], dim=-1)


def _extents(prior: ShapePrior, code: Tensor) -> Tensor:
    values = prior.values(code)
    if not takes_loops(values):
        return zero_level_extents(values, prior.origin, prior.spacing_m)
    from directshape_torch.kernels.extents import extents  # Numba may be missing.

    nodes = values.new_empty(len(values), 3, 2)
    extents(array(values), array(nodes))
    return prior.origin + prior.spacing_m * nodes.mT


@torch.no_grad()
def compared(result: RefinementResult, cars: CarBatch, image_noise: ImageNoise) -> DetectorComparison:
    """Compare the images' boxes of B refined cars with the detector's boxes."""
    origin = result.T_cam_obj[:, :3, 3].double()
    J = quantities_jacobian(result.prior, _state(result))
    of_images = image_noise.covariance(J @ result.covariance @ J.mT)
    difference = _difference(result, cars.detector_T_cam_obj, cars.detector_hwl)
    gain, distance_in_sigmas = torch.zeros_like(of_images), torch.full_like(origin[:, 0], torch.nan)
    covariance = of_images
    if cars.detector_noise is not None:
        of_detector = torch.diag_embed(cars.detector_noise.to(of_images) ** 2)
        of_both = of_images + of_detector
        # Both covariances are symmetric, so the gain is the transpose of the solution of `of_both @ X = of_images`.
        gain = torch.linalg.solve_ex(of_both, of_images)[0].mT
        weighed = torch.linalg.solve_ex(of_both, difference[:, :, None])[0]
        distance_in_sigmas = (difference[:, None] @ weighed)[:, 0, 0].sqrt()
        covariance = gain @ of_detector
        covariance = 0.5 * (covariance + covariance.mT)
    if cars.is_from_masks is not None:
        # A box that was made of the same images says nothing besides them.
        alone = cars.is_from_masks[:, None, None]
        gain, covariance = gain.masked_fill(alone, 0.0), torch.where(alone, of_images, covariance)
        difference = difference.masked_fill(alone[:, 0], torch.nan)
        distance_in_sigmas = distance_in_sigmas.masked_fill(alone[:, 0, 0], torch.nan)
    return DetectorComparison(
        distance=torch.hypot(origin[:, 0], origin[:, 2]),
        difference=difference,
        sigma_images=of_images.diagonal(dim1=1, dim2=2).sqrt(),
        gain=gain,
        covariance=covariance,
        distance_in_sigmas=distance_in_sigmas,
    )


@torch.no_grad()
def chances(result: RefinementResult, comparison: DetectorComparison, brings_together: bool) -> tuple[Tensor, Tensor]:
    """`trust.probabilities` of the boxes that will be returned: the most probable boxes, or the images' boxes."""
    axes = viewing_axes(result.T_cam_obj[:, :3, 3].double())
    length = axes @ result.T_cam_obj[:, :3, :1].double()
    moved = (comparison.gain @ comparison.difference[:, :, None])[:, :, 0]
    returned = torch.zeros_like(moved) if brings_together else -moved
    _, hwl = level_boxes(result.prior, result.T_cam_obj, result.code)
    turned = torch.atan2(length[:, 1, 0], length[:, 0, 0])
    return probabilities(returned, comparison.difference - moved, comparison.covariance, hwl, turned)


def fused(result: RefinementResult, cars: CarBatch) -> RefinementResult:
    """The result with the images' boxes moved to the most probable boxes between them and the detector's boxes.

    Views of a track keep the images' boxes, because the views already support one another.
    """
    gains = result.comparison.gain
    known = gains.isfinite().flatten(1).all(dim=1) & gains.flatten(1).any(dim=1)
    rows = (result.refined & known & (result.track_part < 0)).nonzero()[:, 0]
    if not len(rows):
        return result
    own, boxes, gain = result.rows(rows), (cars.detector_T_cam_obj[rows], cars.detector_hwl[rows]), gains[rows]
    difference = _difference(own, *boxes)
    with torch.no_grad():
        J = quantities_jacobian(own.prior, _state(own))
    # The first step is linear, but sizes are not linear in the code. The second step corrects what is left.
    target = (gain @ difference[..., None])[..., 0]
    state = _state(own)
    unknowns = state.unknowns
    first = unknowns.retract(state, _least_step(unknowns, J, target))
    left = target - (difference - _difference(_at(own, first), *boxes))
    moved = _at(own, unknowns.retract(first, _least_step(unknowns, J, left)))
    T_cam_obj = result.T_cam_obj.index_copy(0, rows, moved.T_cam_obj)
    return replace(result, T_cam_obj=T_cam_obj, code=result.code.index_copy(0, rows, moved.code))


def _least_step(unknowns: Unknowns, J: Tensor, change: Tensor) -> Tensor:
    """The least step (R, D) of the unknowns that changes the quantities by `change` (R, 7).

    The pose changes place and heading; the shape, whose unit is its own standard deviation, changes the sizes.
    """

    def solved(J: Tensor, change: Tensor) -> Tensor:
        ridge = _RIDGE * torch.eye(J.shape[1], dtype=J.dtype, device=J.device)
        step: Tensor = (J.mT @ torch.linalg.solve_ex(J @ J.mT + ridge, change[..., None])[0])[..., 0]
        return step

    parts = (POSE, slice(0, 4)), (CODE, slice(4, 7))
    return torch.cat([solved(J[:, rows, unknowns.span(name)], change[:, rows]) for name, rows in parts], dim=1)


def _state(result: RefinementResult) -> CarState:
    return CarState.of(se3.inverse(result.T_cam_obj), result.code)


def _at(result: RefinementResult, state: CarState) -> RefinementResult:
    return replace(result, T_cam_obj=se3.inverse(state.T_obj_cam), code=state.code)


def _difference(result: RefinementResult, T_detector: Tensor, hwl: Tensor) -> Tensor:
    """The detector's boxes minus the result's boxes, (B, 7) in `CAR_QUANTITIES`, float64."""
    bottom, own_hwl = level_boxes(result.prior, result.T_cam_obj, result.code)
    axes = viewing_axes(result.T_cam_obj[:, :3, 3].detach())
    along, across, down = (axes @ (T_detector[:, :3, 3] - bottom)[..., None])[..., 0].unbind(dim=1)
    turned = rotation_y_from_pose(T_detector) - rotation_y_from_pose(result.T_cam_obj)
    # The heading is taken modulo half a turn, because only the detector knows which end of a car is its front.
    heading = 0.5 * torch.atan2(torch.sin(2 * turned), torch.cos(2 * turned))
    height, width, length = (hwl - own_hwl).unbind(dim=1)
    return torch.stack([along, across, -down, HEADING_LEVER_M * heading, length, width, height], dim=1).double()
