"""A term of one's own is examined as the built-in ones are."""

from __future__ import annotations

import pytest
import torch
from check_gradients import load_factory

from directshape_torch.errors import InputError
from directshape_torch.laboratory.bench import Bench
from directshape_torch.laboratory.regimes import REGIMES
from directshape_torch.laboratory.scenes import LaboratoryScene
from directshape_torch.laboratory.study import compare_subjects
from directshape_torch.scene import Detections, FrameBatch
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.terms.cars import CarBatch, CarState
from directshape_torch.terms.priors import PriorResidual, PriorTerm
from directshape_torch.terms.term import Term


def on_the_axis(_: CarBatch, state: CarState) -> PriorResidual:
    """The object frame's x coordinate of the camera: moved by the tangent as `v_x + (omega x X)_x`."""
    t = state.T_obj_cam[:, :3, 3]
    J = torch.zeros(len(t), 1, 6 + state.code.shape[1], dtype=t.dtype)
    J[:, 0, 0], J[:, 0, 4], J[:, 0, 5] = 1, t[:, 2], -t[:, 1]
    return PriorResidual(t[:, :1], J)


def on_the_axis_wrong(cars: CarBatch, state: CarState) -> PriorResidual:
    at = on_the_axis(cars, state)
    return at._replace(J_residual_state=-at.J_residual_state)


def right(_f: FrameBatch, _d: Detections, cars: CarBatch, _p: ShapePrior) -> Term:
    return PriorTerm("on_the_axis", 1.0, cars, on_the_axis, 1)


def wrong(_f: FrameBatch, _d: Detections, cars: CarBatch, _p: ShapePrior) -> Term:
    return PriorTerm("on_the_axis", 1.0, cars, on_the_axis_wrong, 1)


def test_a_right_and_a_wrong_one(scene: LaboratoryScene, prior: PCAShapePrior) -> None:
    for factory, broken in ((right, 0), (wrong, 2)):
        bench = Bench.build(scene, prior, REGIMES["typical"], 2, pixels_per_car=4, own_terms=(factory,))
        first, second = compare_subjects(bench, ["on_the_axis"], second=True)
        assert len(first.broken_bounds()) == broken
        assert (first.compared, second.name) == (16, "gradient of on_the_axis")


def test_factories_are_found_by_name() -> None:
    assert load_factory(f"{__name__}:right") is right
    with pytest.raises(InputError, match="no_such_module"):
        load_factory("no_such_module:f")
    with pytest.raises(InputError, match="nothing_here"):
        load_factory(f"{__name__}:nothing_here")
