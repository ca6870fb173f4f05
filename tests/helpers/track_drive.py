"""This module has a drive of three frames past two cars, and its refinements with and without tracks."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import pytest
import torch
from torch import Tensor

from directshape_torch.config import RefinerConfig, StageConfig
from directshape_torch.refinement import make_result
from directshape_torch.refinement import refined as refinements
from directshape_torch.refinement.problem import CarMinimum
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import FrameBatch
from directshape_torch.solver.problem import where_rows
from directshape_torch.solver.sharing import Groups
from directshape_torch.state.unknowns import AnyState
from directshape_torch.status import Status
from helpers.ellipsoids import ellipsoid_prior
from helpers.problems import DEFAULT
from helpers.synthetic_scene import (
    CAMERA_HEIGHT_M,
    Street,
    disturbed,
    joined_detections,
    joined_frames,
    street,
)

HEADINGS = (0.3, 1.2, 2.4)
# A few steps are enough to tell results apart.
QUICK = replace(DEFAULT, stages=(StageConfig(2.0, 1, 2), StageConfig(0.5, 0, 3)))


@cache
def drive(contrast: float = 1.0) -> tuple[FrameBatch, Detections, Tensor]:
    """Three frames of a car that turns and of a still one: frames, disturbed boxes, the true codes."""
    prior = ellipsoid_prior()
    code = contrast * torch.tensor([[0.9, -0.4, 0.5], [-0.8, 0.3, -0.4]], dtype=torch.float64)
    height = CAMERA_HEIGHT_M
    seen: list[Street] = [
        street(prior, [(-1.3, height, 8.0 + n), (2.1, height, 12.0 - n)], [heading, -1.2], code)
        for n, heading in enumerate(HEADINGS)
    ]
    frames = joined_frames([view.frames for view in seen])
    detections = joined_detections([view.detections for view in seen], (120, 160))
    mean = prior.dimensions_and_derivative(torch.zeros_like(detections.T_cam_obj[:, :3, 0])).hwl
    return frames, replace(disturbed(detections), dimensions_hwl=mean), code.repeat(len(seen), 1)


def refined(
    detections: Detections,
    track_id: list[int] | None = None,
    contrast: float = 1.0,
    config: RefinerConfig = QUICK,
) -> RefinementResult:
    ids = None if track_id is None else torch.tensor(track_id)
    return DirectShapeRefiner(ellipsoid_prior(), config)(drive(contrast)[0], replace(detections, track_id=ids))


@cache
def by_themselves() -> RefinementResult:
    """The result of all six detections without tracks, which must not be changed."""
    return refined(drive()[1])


@cache
def of_tracks(*track_id: int) -> RefinementResult:
    """The result of the six detections with these tracks, which must not be changed."""
    return refined(drive()[1], list(track_id))


def assert_same(one: RefinementResult, other: RefinementResult) -> None:
    first, second = one.state_dict(), other.state_dict()
    for name, values in first.items():
        assert torch.equal(torch.nan_to_num(values), torch.nan_to_num(second[name])), name


def doubt(monkeypatch: pytest.MonkeyPatch, *in_track: int, alone: int | None = None, num_rows: int = 6) -> None:
    """Make views untrusted in calls or tracks of so many rows."""

    def judged(
        minimum: CarMinimum[AnyState], initial: AnyState, *args: Any
    ) -> tuple[CarMinimum[AnyState], RefinementResult]:
        minimum, found = make_result.judged(minimum, initial, *args)
        rows = in_track if isinstance(minimum.stage.problem.sharing, Groups) else (alone,)
        if len(minimum.status) != num_rows:
            return minimum, found
        doubtful = torch.tensor([row in rows for row in range(num_rows)])
        status = torch.where(doubtful, Status.not_trusted.code, minimum.status)
        state = where_rows(doubtful, initial, minimum.state)
        return replace(minimum, state=state, status=status), replace(found, status_code=status)

    monkeypatch.setattr(refinements, "judged", judged)
