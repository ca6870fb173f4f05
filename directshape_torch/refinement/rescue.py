"""This module finds cars from their masks where the given boxes do not lead to them.

A refinement moves a box by a metre and twenty degrees. A car whose box is farther off ends refused, far from its box or
beside its mask. It gets a box of its mask (`lost_cars`) and is refined again. What is found then has one of
three explanations: the detector is off by what it is usually off by; its box is a gross error, which says nothing of
the car; or the mask does not show the car. The evidence of `trust` weighs the first against the third. The derivation
is in docs/derivations/fusion.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from directshape_torch.config import AcceptanceConfig, RefinerConfig
from directshape_torch.geometry import se3
from directshape_torch.geometry.projection import project
from directshape_torch.numerics.gradient_mode import is_plain
from directshape_torch.numerics.tables import Chosen
from directshape_torch.refinement.fusion import chances, compared, fused
from directshape_torch.refinement.make_result import going_on
from directshape_torch.refinement.observability import covariance_xyz_yaw
from directshape_torch.refinement.quality import evidence_of_distance, is_judged
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.refinement.trust import bundled_trust_model
from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import FrameBatch
from directshape_torch.state.cars import CarBatch
from directshape_torch.status import Status

# The images refute these results, and a wrong box explains it. (It does not explain `rejected_worse`, where the images
# like the box better than what came of it.)
_REFUTED = (Status.mask_missed, Status.no_match, Status.depth_unknown, Status.no_car)
# Good fits cover their masks better than this.
_LOOSE_IOU = 0.8
# One box in twenty is a gross error, as one mask in twenty does not show what its box says.
_GROSS = 0.05
# The odds that there is a car rise by about this factor where its mask stands out: 95 % of the masks of rendered and
# kitti15 do on their own images, and 12 % on the next one (scripts/wrong_boxes.py).
_ODDS_OF_STANDING_OUT = 8.0
# The mask belongs to the box if it overlaps the 2D box by this IoU.
_LEAST_IOU_2D = 0.5


def searched(
    config: RefinerConfig,
    frames: FrameBatch,
    detections: Detections,
    cars: CarBatch,
    result: RefinementResult,
    refine: Callable[[Detections, Tensor], tuple[RefinementResult, CarBatch]],
) -> RefinementResult:
    """The result with cars that were found from their masks, as the setting `search` asks.

    Gradients hold for the start that a car was given, and the choice of the start has none.

    Args:
        config: settings of the refiner.
        frames: frames of the call, with what is known of the rig.
        detections: detections of the call.
        cars: the cars of the detections.
        result: what came of the given boxes.
        refine: refines some cars (B,) of other detections.
    """
    # Under a transform of `torch.func` the disparity of the images cannot be matched.
    if config.search == "off" or not is_judged(result.term_names) or not is_plain(frames.images_left):
        return result
    lost = _has_own_mask(frames, detections) & (result.refined | _is_of(result, (*_REFUTED, Status.not_trusted)))
    if config.search == "rescue":
        lost = lost & _is_doubted(result)
    if not bool(lost.any()):
        return result
    # The import stands here, because only cars in doubt need it.
    from directshape_torch.refinement.lost_cars import boxes_of_lost_cars

    made, lost = boxes_of_lost_cars(frames, detections, result, lost)
    if not bool(lost.any()):
        return result
    again, _ = refine(made, lost)
    found = Chosen.where(lost & again.refined)
    given = replace(cars, detector_T_cam_obj=detections.T_cam_obj).of(found)
    before = result.rows(found.index)
    later = fused(_explained(again.rows(found.index), given, before), given)
    kept = _is_better(later, before, config.acceptance).nonzero()[:, 0]
    return going_on(result, found.index[kept], later.rows(kept)) if len(kept) else result


def _is_better(later: RefinementResult, before: RefinementResult, limits: AcceptanceConfig) -> Tensor:
    """Whether (B,) cars that were found from their masks are likely better than the given boxes and than before."""
    quality = later.quality
    likely = (quality.probability_better >= limits.min_probability_better) & (
        quality.probability_not_worse >= limits.min_probability_not_worse
    )
    # A box that is off as usual has led to its car, so what came of it stays, unless the images refute it.
    closer = quality.mask_iou_left > before.quality.mask_iou_left
    elsewhere = _is_gross(quality.evidence) & (_is_gross(before.quality.evidence) | closer)
    return likely & (~before.refined | elsewhere)


def _is_of(result: RefinementResult, statuses: tuple[Status, ...]) -> Tensor:
    return torch.stack([result.status_code == each.code for each in statuses]).any(dim=0)


def _is_doubted(result: RefinementResult) -> Tensor:
    """Whether (B,) results are refuted, lie where their boxes are no measurement of them, or do not cover their masks.

    A result that is merely not trusted has found its car, and would be found there again.
    """
    quality = result.quality
    return _is_of(result, _REFUTED) | _is_gross(quality.evidence) | (quality.mask_iou_left < _LOOSE_IOU)


def _has_own_mask(frames: FrameBatch, detections: Detections) -> Tensor:
    """Whether (B,) cars have a detector's box, are in no track, and have a mask that belongs to their box.

    The middle of the 3D box lies within the extents of such a mask, and the 2D box agrees with them.
    """
    middle = torch.zeros_like(detections.dimensions_hwl)
    middle[:, 1] = -0.5 * detections.dimensions_hwl[:, 0]
    uv = project(se3.transform(detections.T_cam_obj, middle), frames.camera.K_left[detections.frame_index])
    of_mask, box = detections.mask_left.box_2d.to(uv), detections.box_2d
    belongs = ((uv >= of_mask[:, :2]) & (uv <= of_mask[:, 2:])).all(dim=1)
    # A detector without 2D boxes writes NaN, or boxes without an area.
    belongs = belongs & ~((_areas(box) > 0) & (_iou(of_mask, box) < _LEAST_IOU_2D))
    if detections.is_from_masks is not None:
        belongs = belongs & ~detections.is_from_masks
    return belongs if detections.track_id is None else belongs & (detections.track_id < 0)


def _iou(boxes: Tensor, others: Tensor) -> Tensor:
    """Intersection over union (B,) of image boxes (B, 4) with one other box each."""
    low, high = torch.maximum(boxes[:, :2], others[:, :2]), torch.minimum(boxes[:, 2:], others[:, 2:])
    shared = _areas(torch.cat([low, high], dim=1))
    return shared / (_areas(boxes) + _areas(others) - shared)


def _areas(boxes: Tensor) -> Tensor:
    return (boxes[:, 2:] - boxes[:, :2]).clamp_min(0).prod(dim=1)


@torch.no_grad()
def _explained(found: RefinementResult, given: CarBatch, before: RefinementResult) -> RefinementResult:
    """The cars that were found from their masks, with what is said of them beside their given boxes.

    The comparison is that of the likelier explanation: where the given box is a gross error, it is not weighed.
    """
    noise = bundled_trust_model().image_noise
    usual, alone = (compared(found, cars, noise) for cars in (given, replace(given, detector_noise=None)))
    evidence = found.quality.evidence.clone()
    evidence[:, 2] = evidence_of_distance(usual.distance_in_sigmas)
    is_usual, is_gross = _explanations(evidence)
    weighed, apart, gross = (
        torch.stack(chances(found, comparison, brings_together))
        for comparison, brings_together in ((usual, True), (usual, False), (alone, True))
    )
    chance = torch.where(is_gross > is_usual, is_gross * gross + is_usual * apart, is_usual * weighed)
    rows = (is_gross <= is_usual).nonzero()[:, 0]
    comparison = replace(alone, distance_in_sigmas=usual.distance_in_sigmas).put(rows, usual.rows(rows))
    return replace(
        found,
        status_code=torch.full_like(found.status_code, Status.rescued.code),
        comparison=comparison,
        covariance_xyz_yaw=covariance_xyz_yaw(comparison.covariance, found.T_cam_obj[:, :3, 3]),
        quality=replace(
            found.quality, evidence=evidence, probability_better=chance[0], probability_not_worse=chance[1]
        ),
        input_dimensions_hwl=before.input_dimensions_hwl,
    )


def _explanations(evidence: Tensor) -> tuple[Tensor, Tensor]:
    """Probabilities (B,) that the car is there and its box is off as usual, and that its box is a gross error.

    The distance of a gross error, as that of a mask without a car, may be any. So it tells both from a usual box, by
    the odds of the model of trust, and not one from the other.
    """
    is_there = bundled_trust_model().car_is_there
    nowhere = evidence.clone()
    nowhere[:, 2] = torch.nan
    usual, gross = (_ODDS_OF_STANDING_OUT * p / (1 - p) for p in (is_there(evidence), is_there(nowhere)))
    gross = _GROSS / (1 - _GROSS) * gross
    return usual / (1 + usual + gross), gross / (1 + usual + gross)


def _is_gross(evidence: Tensor) -> Tensor:
    is_usual, is_gross = _explanations(evidence)
    return is_gross > is_usual
