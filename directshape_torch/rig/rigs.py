"""This module holds the estimates of several rigs that one detector uses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from directshape_torch.rig import detector_noise
from directshape_torch.rig.estimate import RigEstimate
from directshape_torch.rig.rig import Rig
from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import FrameBatch

if TYPE_CHECKING:
    from directshape_torch.refinement.result import RefinementResult


class RigEstimates(nn.ModuleList):
    """These are the estimates of several rigs, for a refiner. Each of its calls has frames of one rig."""

    def __init__(self, rigs: Sequence[RigEstimate]) -> None:
        super().__init__(rigs)

    def corrected(self, frames: FrameBatch) -> FrameBatch:
        """The frames as the estimate of their rig corrects them; frames of an unknown rig stay as they are."""
        rig = self._of(frames)
        return frames if rig is None else rig.corrected(frames)

    def informed(self, frames: FrameBatch, detections: Detections) -> Detections:
        """The detections with what the estimate of their rig knows; detections of an unknown rig stay unchanged."""
        rig = self._of(frames)
        return detections if rig is None else rig.informed(frames, detections)

    def learn(self, frames: FrameBatch, result: RefinementResult) -> None:
        """The estimate of the frames' rig learns from the result; a result of an unknown rig is left out."""
        rig = self._of(frames)
        if rig is not None:
            rig.learn(frames, result)

    @property
    def results(self) -> Tensor:
        """The results (N, 15) of all rigs, because one detector uses all of them."""
        nothing = torch.zeros(0, detector_noise.NUM_COLUMNS, dtype=torch.float64)
        return torch.cat([nothing, *(rig.results for rig in self if isinstance(rig, RigEstimate))])

    def detector_sigmas(self) -> Tensor | None:
        """`RigEstimate.detector_sigmas` of the results of all rigs together."""
        results = self.results
        return detector_noise.detector_sigmas(results) if len(results) else None

    def _of(self, frames: FrameBatch) -> RigEstimate | None:
        rig = Rig.of_frame(frames)
        return next((known for known in self if known.is_of(*rig)), None)  # type: ignore[operator, return-value]


def rig_among(rigs: list[RigEstimate], rig: Rig) -> RigEstimate:
    """The estimate of a rig; if there is none, one without evidence joins the list."""
    known = [estimate for estimate in rigs if estimate.is_of(*rig)] or [RigEstimate(*rig)]
    if known[0] not in rigs:
        rigs.append(known[0])
    return known[0]
