"""One training: corrections in front of the refiner, boxes behind it, gradients through it."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.result import RefinementResult
from directshape_torch.solver.differentiate import NotStationaryWarning
from refiner_training.box_loss import box_losses, refined_boxes
from refiner_training.car_frames import CarBatch, CarFrame, joined
from refiner_training.networks import TERMS, Correction, corrected_masks

# The gradient of one car may not exceed this, nor that of all parameters: a step of the solver near a kink can be huge.
LARGEST_CAR_GRADIENT = 0.3
LARGEST_GRADIENT = 1.0
HELD_OUT_EVERY = 4


@dataclass(frozen=True)
class TrainingSettings:
    """How a correction is trained."""

    epochs: int
    rate: float
    weight_decay: float
    frames_per_step: int
    seed: int


@dataclass(frozen=True)
class Epoch:
    """What one pass over the training frames saw.

    Attributes:
        loss: mean over the cars before each step.
        with_gradient: cars that moved the parameters.
        without_gradient: cars that were skipped: not refined, or their gradient does not exist.
        held_out_loss: mean over the cars of the other frames after the epoch; NaN for most epochs, to save time.
    """

    loss: float
    with_gradient: int
    without_gradient: int
    held_out_loss: float


def refine(refiner: DirectShapeRefiner, batch: CarBatch, correction: Correction) -> RefinementResult:
    """Refine the cars of a batch with corrected masks and term weights."""
    d, inputs = batch.detections, batch.inputs
    detections = replace(
        d,
        mask_left=corrected_masks(d.mask_left, inputs.region_left, correction.residual_left),
        mask_right=corrected_masks(d.mask_right, inputs.region_right, correction.residual_right),
    )
    factors = correction.log_factors.exp()
    with warnings.catch_warnings():
        # The loop counts these cars itself.
        warnings.simplefilter("ignore", NotStationaryWarning)
        result: RefinementResult = refiner(batch.frames, detections, dict(zip(TERMS, factors.unbind(1), strict=True)))
    return result


def batch_losses(
    refiner: DirectShapeRefiner, batch: CarBatch, correction: Correction
) -> Tensor:  # (N,), only counted cars that were refined
    """Loss of each counted car of a batch that could be refined."""
    result = refine(refiner, batch, correction)
    refined = result.refined[batch.rows]
    return box_losses(refined_boxes(result)[batch.rows[refined]], batch.true_boxes[refined])


def train_step(
    refiner: DirectShapeRefiner, batch: CarBatch, corrector: nn.Module, optimiser: torch.optim.Optimizer
) -> tuple[Tensor, int]:
    """One step of the optimiser.

    Returns:
        Losses (N,) before the step, and the number of cars that had a gradient.
    """
    correction = corrector(batch.inputs)
    # Even where no network makes them, the factors tell which cars the gradient reaches.
    if not correction.log_factors.requires_grad:
        correction.log_factors.requires_grad_()
    reached: list[Tensor] = []
    correction.log_factors.register_hook(lambda gradient: reached.append(_sizes(gradient) > 0))
    for part in correction:
        if part is not None:
            part.register_hook(_clipped_by_car)
    losses = batch_losses(refiner, batch, correction)
    parameters = [p for group in optimiser.param_groups for p in group["params"]]
    optimiser.zero_grad()
    if not losses.requires_grad:
        return losses.detach(), 0
    torch.autograd.backward(losses.sum())
    count = int(reached[0].sum()) if reached else 0
    for parameter in parameters:
        if parameter.grad is not None:
            parameter.grad /= max(count, 1)
    norm = nn.utils.clip_grad_norm_(parameters, LARGEST_GRADIENT)
    if not count or not bool(norm.isfinite()):
        return losses.detach(), 0
    optimiser.step()
    return losses.detach(), count


def train(
    refiner: DirectShapeRefiner,
    corrector: nn.Module,
    frames: Sequence[CarFrame],
    held_out: Sequence[CarFrame],
    settings: TrainingSettings,
    on_epoch: Callable[[], None] = lambda: None,
) -> list[Epoch]:
    """Train a correction in place.

    Args:
        refiner: with a backward mode.
        corrector: what is trained.
        frames: to train on.
        held_out: other frames, for the learning curve alone: nothing is chosen by them.
        settings: of the optimiser.
        on_epoch: called after every epoch.
    """
    optimiser = torch.optim.AdamW(corrector.parameters(), lr=settings.rate, weight_decay=settings.weight_decay)
    generator = torch.Generator().manual_seed(settings.seed)
    steps_per_epoch = math.ceil(len(frames) / settings.frames_per_step)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, max(1, settings.epochs * steps_per_epoch))
    epochs = []
    for number in range(1, settings.epochs + 1):
        losses, count = [], 0
        order = torch.randperm(len(frames), generator=generator).tolist()
        for first in range(0, len(order), settings.frames_per_step):
            batch = joined([frames[k] for k in order[first : first + settings.frames_per_step]])
            step_losses, step_count = train_step(refiner, batch, corrector, optimiser)
            if step_count:
                schedule.step()
            losses.append(step_losses)
            count += step_count
        total = sum(len(frame.counted) for frame in frames)
        is_due = number in (1, settings.epochs) or number % HELD_OUT_EVERY == 0
        held_out_loss = mean_loss(refiner, corrector, held_out, settings.frames_per_step) if is_due else math.nan
        epochs.append(Epoch(float(torch.cat(losses).mean()), count, total - count, held_out_loss))
        on_epoch()
    return epochs


@torch.no_grad()
def mean_loss(
    refiner: DirectShapeRefiner, corrector: nn.Module, frames: Sequence[CarFrame], frames_per_call: int = 1
) -> float:
    """Mean loss of the counted cars of some frames; NaN where there are none."""
    batches = [joined(frames[k : k + frames_per_call]) for k in range(0, len(frames), frames_per_call)]
    losses = [batch_losses(refiner, batch, corrector(batch.inputs)) for batch in batches]
    return float(torch.cat(losses).mean()) if losses else math.nan


def _clipped_by_car(gradient: Tensor) -> Tensor:
    """The gradient (B, ...) with that of each car clipped; one that is no number is none."""
    gradient = gradient.nan_to_num(0.0, 0.0, 0.0)
    scale = LARGEST_CAR_GRADIENT / _sizes(gradient).clamp_min(LARGEST_CAR_GRADIENT)
    return gradient * scale.reshape(-1, *[1] * (gradient.ndim - 1))


def _sizes(gradient: Tensor) -> Tensor:
    """Norm (B,) of the gradient of each car, zero where it is no number."""
    sizes: Tensor = torch.linalg.vector_norm(gradient.nan_to_num(0.0, 0.0, 0.0).flatten(1), dim=1)
    return sizes
