"""A term of one's own is examined as the built-in ones are; what it gives wrong is named."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest
import torch

from directshape_torch.errors import InputError
from directshape_torch.laboratory.bench import Bench
from directshape_torch.laboratory.own_term import checked_term, load_factory
from directshape_torch.laboratory.regimes import REGIMES
from directshape_torch.laboratory.scenes import LaboratoryScene
from directshape_torch.laboratory.study import compare_subjects
from directshape_torch.scene import Detections, FrameBatch
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.terms.cars import CarBatch, CarState
from directshape_torch.terms.priors import PriorResidual, PriorTerm
from directshape_torch.terms.term import Linear, Term


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


@dataclass(frozen=True)
class _Altered:
    """A term of which one attribute is another, or one method's result."""

    term: Term
    name: str
    value: Any

    def __getattr__(self, name: str) -> Any:
        return self.value if name == self.name else getattr(self.term, name)


def test_wrong_shapes_are_named(bench_of: Callable[..., Bench]) -> None:
    bench = bench_of("typical")
    term, sight = bench.terms["height"], bench.sight
    assert checked_term(term, sight) is term
    at = term.linear(sight.field, sight.state, ())
    cases: list[tuple[str, Any, str]] = [
        ("column", torch.zeros(3).long(), r"term 'height': expected column of \(2,\)"),
        ("column", torch.ones(2).long(), r"column of \[0\] \(numbers of its names\), got \[1\]"),
        ("block_weight", torch.ones(2), "block_weight.dtype of torch.float64"),
        ("information", torch.ones(1).double(), r"information of \(2,\)"),
        ("row_weight", torch.ones(2, 1), r"row_weight of \(2, 1, 1\)"),
        ("blocks", replace_counts(term), "blocks.counts"),
        ("linear", lambda *_: at._replace(residual=at.residual[..., 0]), r"residual of \(2, 'R', 'N'\)"),
        ("linear", lambda *_: at._replace(J_inner_state=at.J_inner_state[..., :6]), r"J_inner_state of \(2, 1, 8\)"),
        ("linear", lambda *_: Linear(at[0], at[1][..., 0], *at[2:]), r"J_residual_inner of \(2, 1, 1\)"),
        ("residual", lambda *_: at.residual[..., 0], r"residual\(...\) of \(2, 1, 1\)"),
        ("norm", lambda r: type(term.norm(r))(*(x[..., 0] for x in term.norm(r))), r"norm\(...\).rho"),
        ("moving", lambda *_: (term, (), torch.zeros(2)), r"moving\(...\)\[2\] of \(2, 1\)"),
    ]
    for name, value, message in cases:
        with pytest.raises(InputError, match=message):
            checked_term(_Altered(term, name, value), sight)


def replace_counts(term: Term) -> Any:
    return term.blocks._replace(counts=(2, 0))


def test_factories_are_found_by_name() -> None:
    assert load_factory(f"{__name__}:right") is right
    with pytest.raises(InputError, match="no_such_module"):
        load_factory("no_such_module:f")
    with pytest.raises(InputError, match="nothing_here"):
        load_factory(f"{__name__}:nothing_here")
