"""Terms of a user count like the package's, and NaN stays in its car."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Annotated, Any, Self

import pytest
import torch
from helpers.own_terms import lower_by, made, refine
from helpers.problems import DEFAULT
from helpers.street_inputs import SETTLED, StreetInputs, with_mode
from helpers.synthetic_scene import cached_street, disturbed, measured_street, select
from torch import Tensor

from directshape_torch.config import PointCloudConfig, RefinerConfig
from directshape_torch.errors import InputError
from directshape_torch.numerics.records import Dense
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.rows import Blocks
from directshape_torch.shape.field import Field
from directshape_torch.state.cars import CarBatch, CarState
from directshape_torch.state.unknowns import CODE, OFFSET, POSE
from directshape_torch.status import Status
from directshape_torch.terms.car_points import car_points
from directshape_torch.terms.point_cloud import PointCloud
from directshape_torch.terms.priors import PriorResidual, PriorTerm
from directshape_torch.terms.robust import RobustValue, quadratic
from directshape_torch.terms.term import Linear, NoAnchor, Prepared, Term


@cache
def healthy() -> RefinementResult:
    """The result with the term on the ground itself, which must not be changed."""
    return refine(made(residual_of=lower_by(0.0)))


def test_a_prior_of_ones_own_counts_like_ours() -> None:
    without = replace(DEFAULT, priors=replace(DEFAULT.priors, height_weight=0.0))
    result = refine(made(), config=without)
    assert result.refined.all()
    assert result.term_names[-1] == "user"
    lower = result.T_cam_obj[:, 1, 3] - refine(config=DEFAULT).T_cam_obj[:, 1, 3]
    torch.testing.assert_close(lower, torch.full((2,), 0.1).double(), rtol=0, atol=0.04)


def test_points_of_a_lidar_count_like_those_of_stereo() -> None:
    prior, scene = measured_street()
    detections = disturbed(scene.detections, 0.25, 0.08)
    cloud = PointCloudConfig(weight=1000.0, min_points=50)

    def lidar(frames: Any, detections: Any, *_: Any) -> PointCloud:
        return PointCloud.of_points(cloud, car_points(frames, detections, cloud), "lidar")

    extra = DirectShapeRefiner(prior, DEFAULT, [lidar])(scene.frames, detections)
    combined = DirectShapeRefiner(prior, replace(DEFAULT, point_cloud=cloud))
    torch.testing.assert_close(extra.T_cam_obj, combined(scene.frames, detections).T_cam_obj, rtol=0, atol=1e-9)


def heights(metres: Tensor | float, config: RefinerConfig, derived: bool = False) -> Tensor:
    """The summed heights of the cars above a ground that is lower by so many metres."""
    inputs, by_hand = StreetInputs(), lower_by(metres)
    residual_of: Any = (lambda cars, state: by_hand(cars, state).residual) if derived else by_hand
    detections = replace(inputs.detections, mask_left=inputs.mask)
    refiner = DirectShapeRefiner(inputs.prior, config, [made(residual_of=residual_of, weight=100.0)])
    result: RefinementResult = refiner(inputs.scene.frames, detections)
    return result.T_cam_obj[:, 1, 3].sum()


@cache
def slope_of_heights() -> float:
    step = 1e-5
    return float(heights(step, SETTLED) - heights(-step, SETTLED)) / (2 * step)


@pytest.mark.parametrize(("mode", "derived"), [("implicit", False), ("unroll", True)])
def test_a_term_of_ones_own_carries_gradients(mode: str, derived: bool) -> None:
    metres = torch.zeros((), dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(heights(metres, with_mode(mode), derived), metres)
    assert float(gradient) == pytest.approx(slope_of_heights(), rel=1e-3)
    assert slope_of_heights() > 0.1


def test_no_cars_need_no_rows() -> None:
    none = select(cached_street()[1].detections, torch.zeros(0, dtype=torch.long))
    assert refine(made(), detections=none).term_names[-1] == "user"


@dataclass(frozen=True)
class LowerTerm(Term):
    """A `LowerTerm` has heights over a lower ground, with numbers that are fields."""

    names: tuple[str, ...]
    cars: CarBatch
    blocks: Blocks
    block_weight: Annotated[Tensor, Dense("B")]
    column: Annotated[Tensor, Dense("B", kind="index")]
    row_weight: Annotated[Tensor, Dense("B", 1, 1)]
    sees = (POSE,)

    @property
    def information(self) -> Tensor:
        return self.block_weight

    @classmethod
    def on(cls, name: str, cars: CarBatch) -> Self:
        weight = torch.full((len(cars),), 1e5, dtype=torch.float64)
        blocks = Blocks.one_each(len(cars), weight.device)
        return cls((name,), cars, blocks, weight, torch.zeros_like(blocks.owner), torch.ones(len(cars), 1, 1).double())

    def linear(self, field: Field, state: CarState, anchor: NoAnchor) -> Linear:
        at, one = lower_by(0.1)(self.cars, state), torch.ones_like(self.row_weight)
        return Linear(at.residual[..., None], one, at.J_residual_state, anchor)

    def residual(self, field: Field, state: CarState, anchor: NoAnchor) -> Tensor:
        return lower_by(0.1)(self.cars, state).residual[..., None]

    def norm(self, residual: Tensor) -> RobustValue:
        return quadratic(residual)


def test_members_may_be_fields_of_a_dataclass() -> None:
    with pytest.raises(TypeError, match="6 required positional arguments"):
        LowerTerm()  # type: ignore[call-arg]
    by_fields = refine(lambda *scene: LowerTerm.on("user", scene[2]))
    by_properties = refine(lambda *scene: PriorTerm("user", 1e5, scene[2], lower_by(0.1), 1, (POSE,), is_prior=False))
    torch.testing.assert_close(by_fields.T_cam_obj, by_properties.T_cam_obj, rtol=0, atol=0)
    torch.testing.assert_close(by_fields.covariance, by_properties.covariance, rtol=0, atol=0)


def test_a_residual_without_a_jacobian_is_differentiated() -> None:
    """By itself, and as that of a term without `linear`, to the last digits of what hand-derived ones give."""
    by_hand = refine(made())

    def height(cars: CarBatch, state: CarState) -> Tensor:
        return lower_by(0.1)(cars, state).residual

    alone = refine(made(residual_of=height))
    of_term = refine(lambda *scene: ResidualTerm.on("user", scene[2]))
    measured = refine(lambda *scene: LowerTerm.on("user", scene[2]))
    for found, expected in ((alone, by_hand), (of_term, measured)):
        torch.testing.assert_close(found.T_cam_obj, expected.T_cam_obj, rtol=0, atol=1e-9)
        torch.testing.assert_close(found.covariance, expected.covariance, rtol=1e-6, atol=1e-12)


class ResidualTerm(LowerTerm):
    """A `ResidualTerm` has only the residual."""

    linear = Term.linear


class TwoToARow(ResidualTerm):
    """A `TwoToARow` has two residuals in each row, which have one inner scalar only if the term says which."""

    def residual(self, field: Field, state: CarState, anchor: NoAnchor) -> Tensor:
        return super().residual(field, state, anchor).expand(-1, -1, 2)


def test_two_residuals_of_a_row_need_a_jacobian_by_hand() -> None:
    with pytest.raises(InputError, match=r"'user': residual\(...\): expected one residual a row.*write linear"):
        refine(lambda *scene: TwoToARow.on("user", scene[2]))


def of_offset(_: CarBatch, state: CarState) -> Tensor:
    """A term that pulls an unknown disparity offset to a pixel; it is absent if the rig is known."""
    return state.offset_px - 1.0


@pytest.mark.parametrize("sees", [(POSE, CODE), (OFFSET,)])
def test_a_residual_without_a_jacobian_is_differentiated_by_every_unknown(sees: tuple[str, ...]) -> None:
    """Whatever it says that it sees: an offset that nobody pulled would end elsewhere."""
    _, scene = cached_street()
    detections = replace(disturbed(scene.detections), offset_sigma_px=torch.full((2,), 0.3, dtype=torch.float64))

    def factory(*given: Any) -> PriorTerm:
        return PriorTerm("user", 1e4, given[2], of_offset, 1, sees)

    pulled, free = (refine(*extra, detections=detections) for extra in ([factory], []))
    nearer = free.T_cam_obj[:, 2, 3] - pulled.T_cam_obj[:, 2, 3]
    assert (nearer.abs() > 0.2).all()


def test_what_begins_a_term_with_a_jacobian_needs_none_itself() -> None:
    class Begins(ResidualTerm):
        def begin(self, stage: Any, prepared: Prepared) -> Any:
            return LowerTerm.on(self.names[0], self.cars)

    found = refine(lambda *scene: Begins.on("user", scene[2]))
    expected = refine(lambda *scene: LowerTerm.on("user", scene[2]))
    torch.testing.assert_close(found.T_cam_obj, expected.T_cam_obj, rtol=0, atol=0)


class TensorTerm(LowerTerm):
    """A `TensorTerm` looks at rows of one tensor, without a tuple around it."""

    def anchor(self, prepared: Prepared) -> Tensor:
        return torch.ones(len(self.blocks.owner), 1)


def test_one_tensor_says_where_rows_look() -> None:
    nowhere, looking = (refine(lambda *scene, kind=kind: kind.on("user", scene[2])) for kind in (LowerTerm, TensorTerm))
    torch.testing.assert_close(looking.T_cam_obj, nowhere.T_cam_obj, rtol=0, atol=0)


def _poisoned(name: str, when: Callable[[CarState], Tensor]) -> Callable[[CarBatch, CarState], PriorResidual]:
    """A term whose residual or Jacobian of the first detection is NaN where a condition (B,) on the state is true."""

    def residual(cars: CarBatch, state: CarState) -> PriorResidual:
        at = lower_by(0.0)(cars, state)
        sick = ((cars.detection_row == 0) & when(state)).view(-1, *[1] * (getattr(at, name).ndim - 1))
        return at._replace(**{name: torch.where(sick, torch.nan, getattr(at, name))})

    return residual


@pytest.mark.parametrize("what", ["residual", "J_residual_state"])
def test_rows_that_are_no_numbers_end_their_own_car_alone(what: str) -> None:
    result = refine(made(residual_of=_poisoned(what, lambda state: torch.ones_like(state.code[:, 0]) > 0)))
    assert result.status[0] is Status.non_finite
    assert torch.equal(result.T_cam_obj[0], disturbed(cached_street()[1].detections).T_cam_obj[0])
    assert result.status[1] is healthy().status[1]
    torch.testing.assert_close(result.T_cam_obj[1], healthy().T_cam_obj[1], rtol=0, atol=1e-9)
    torch.testing.assert_close(result.cost_after[1], healthy().cost_after[1], rtol=1e-9, atol=1e-9)


def test_a_term_that_breaks_on_the_way_leaves_the_best_state_before() -> None:
    """No number wherever the shape is not the mean's: no step can be taken, and the input is the best state."""
    result = refine(made(residual_of=_poisoned("residual", lambda state: (state.code != 0).any(dim=1))))
    assert (result.code[0] == 0).all()
    torch.testing.assert_close(result.T_cam_obj[1], healthy().T_cam_obj[1], rtol=0, atol=1e-9)
