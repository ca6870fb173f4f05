"""Per-car values of a user's term follow the cars that leave; mistakes are named before the first step."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Annotated, Any

import pytest
import torch
from helpers.problems import DEFAULT
from helpers.street_inputs import SETTLED, StreetInputs, with_mode
from helpers.synthetic_scene import cached_street, disturbed, select
from torch import Tensor

from directshape_torch.config import RefinerConfig, StageConfig
from directshape_torch.errors import InputError
from directshape_torch.geometry import se3
from directshape_torch.numerics.records import Dense
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.refinement.scene_problem import TermFactory
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import FrameBatch
from directshape_torch.state.cars import CarBatch, CarState
from directshape_torch.terms.priors import PriorResidual, PriorTerm

COPIES = 3
# Boxes of one car would hide each other.
# A search would ask the factory again, for the cars that it searches for.
CONFIG = replace(DEFAULT, sampling=replace(DEFAULT.sampling, occlusion=False), search="off")
WEIGHT = 2e5
"""Pulls a car to its radar's position whatever the images say."""


def to_radar(_: CarBatch, state: CarState, radar_cam: Tensor) -> PriorResidual:
    """The object origin against a position (B, 3) in the camera frame, metres; the origin moves by -R_cam_obj v."""
    T_cam_obj = se3.inverse(state.T_obj_cam)
    J = torch.nn.functional.pad(-T_cam_obj[:, :3, :3], (0, 3 + state.code.shape[1]))
    return PriorResidual(T_cam_obj[:, :3, 3] - radar_cam, J)


def boxes(*order: int) -> Detections:
    """Two cars with three disturbed boxes each, which end in different iterations."""
    found = cached_street()[1].detections
    parts = [disturbed(found, 0.05 + 0.1 * n, 0.02 + 0.02 * n, seed=n) for n in range(COPIES)]
    return select(Detections.joined(parts), torch.tensor(order or range(2 * COPIES)))


def measured(detections: Detections) -> Tensor:
    """A radar with another error of distance for each box, which is known by its own position."""
    at = detections.T_cam_obj[:, :3, 3]
    return at + torch.stack([0.2 * torch.sin(40 * at[:, 2]), 0 * at[:, 0], 0.2 * torch.cos(40 * at[:, 2])], dim=-1)


def radar(change: Callable[[Tensor], Any] = lambda x: x, weight: Any = WEIGHT, name: str = "radar_cam") -> TermFactory:
    return lambda *scene: PriorTerm("radar", weight, scene[2], to_radar, 3, values={name: change(measured(scene[1]))})


def closed_over(of_call: Callable[..., Tensor], change: Callable[[Tensor], Tensor] = lambda x: x) -> TermFactory:
    """The radar as a residual that takes its positions from the enclosing scope, by a function of table and cars."""

    def make(*scene: Any) -> PriorTerm:
        table = change(measured(scene[1]))
        return PriorTerm("radar", WEIGHT, scene[2], lambda c, s: to_radar(c, s, of_call(table, c)), 3)

    return make


def of_detections(table: Tensor, cars: CarBatch) -> Tensor:
    return table[cars.detection_row]


def refine(*extra: TermFactory, detections: Detections, config: RefinerConfig = CONFIG) -> RefinementResult:
    prior, scene = cached_street(detections.T_cam_obj.dtype)
    result: RefinementResult = DirectShapeRefiner(prior, config, extra)(scene.frames, detections)
    return result


@cache
def together() -> RefinementResult:
    """All boxes in one call; the result must not be changed."""
    return refine(radar(), detections=boxes())


def test_cars_that_leave_take_their_values_along() -> None:
    iterations = together().iterations
    assert len(set(iterations.tolist())) > 1  # so cars left the batch while others stayed
    assert together().refined.all()
    distance = (together().T_cam_obj[:, :3, 3] - measured(boxes())).norm(dim=1)
    assert float(distance.max()) < 0.02


def test_a_car_ends_alike_alone_and_in_any_order() -> None:
    order = (4, 1, 5, 0, 3, 2)
    permuted = refine(radar(), detections=boxes(*order))
    torch.testing.assert_close(permuted.T_cam_obj, together().T_cam_obj[list(order)], rtol=0, atol=1e-9)
    for car in (0, 3):
        alone = refine(radar(), detections=boxes(car))
        torch.testing.assert_close(alone.T_cam_obj[0], together().T_cam_obj[car], rtol=0, atol=1e-9)


def test_cars_that_are_refused_take_their_values_along() -> None:
    detections = boxes()
    behind = detections.T_cam_obj.clone()
    behind[[0, 3], 2, 3] = -5.0
    result = refine(radar(), detections=replace(detections, T_cam_obj=behind))
    others = [1, 2, 4, 5]
    assert not result.refined[[0, 3]].any()
    torch.testing.assert_close(result.T_cam_obj[others], together().T_cam_obj[others], rtol=0, atol=1e-9)


def test_views_of_a_track_have_values_of_their_own() -> None:
    """Two frames of one street, and a radar that sees its cars 3 cm to the left, then 3 cm to the right."""
    prior, scene = cached_street()
    frames, truth = FrameBatch.joined([scene.frames] * 2), scene.detections.T_cam_obj[:, :3, 3].repeat(2, 1)
    found = truth + torch.tensor([-0.03, -0.03, 0.03, 0.03], dtype=truth.dtype)[:, None] * truth.new_tensor([1, 0, 0])
    numbers = torch.tensor([0, 0, 1, 1]), torch.tensor([7, 8, 7, 8])
    detections = replace(boxes(0, 1, 2, 3), frame_index=numbers[0], track_id=numbers[1])
    result = DirectShapeRefiner(prior, CONFIG, [radar(lambda _: found)])(frames, detections)
    torch.testing.assert_close(result.code[:2], result.code[2:])
    assert float((result.T_cam_obj[:, :3, 3] - found).norm(dim=1).max()) < 0.01


def test_gradients_reach_the_values() -> None:
    inputs = StreetInputs()
    detections = replace(inputs.detections, mask_left=inputs.mask)
    metres = torch.zeros((), dtype=torch.float64, requires_grad=True)
    factories = radar(lambda x: x + metres), closed_over(of_detections, lambda x: x + metres)
    few = replace(SETTLED, stages=(StageConfig(1.0, 0, 2),))
    refiners = [DirectShapeRefiner(inputs.prior, with_mode("unroll", few), [make]) for make in factories]
    heights = [refiner(inputs.scene.frames, detections).T_cam_obj[:, 1, 3].sum() for refiner in refiners]
    gradient, by_closure = (float(torch.autograd.grad(height, metres)[0]) for height in heights)
    assert gradient == pytest.approx(by_closure, rel=1e-9)
    assert gradient > 0.5


WRONG: dict[str, tuple[Callable[[Tensor], Any], str]] = {
    "too few rows": (lambda x: x[:-1], r"expected shape \(6, 3\), got \(5, 3\); give the rows of all detections"),
    "a transposed table": (lambda x: x.mT, r"expected shape \(6, 6\), got \(3, 6\); give the rows"),
    "one number": (lambda x: x[0, 0], r"expected shape \(6,\), got \(\); give the rows of all detections"),
    "an array": (
        lambda x: x.numpy(),
        r"expected a tensor of shape \(6, 3\), got ndarray; make one with torch.as_tensor",
    ),
    "nothing": (lambda _: None, r"expected a tensor of shape \(6,\), got NoneType"),
    "another dtype": (
        lambda x: x.float(),
        r"expected the dtype of the cars \(torch.float64\), got torch.float32; move them together",
    ),
    "another device": (lambda x: x.to("meta"), "expected a tensor with numbers, got one on the device 'meta'"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_values_are_named(case: str) -> None:
    change, message = WRONG[case]
    with pytest.raises(InputError, match=r"^extra term 'radar': values\['radar_cam'\]: " + message):
        refine(radar(change), detections=boxes())


CLOSED: dict[str, Callable[..., Tensor]] = {
    "all rows": lambda table, _: table,
    "the first rows": lambda table, cars: table[: len(cars)],
    "the last rows": lambda table, cars: table[len(table) - len(cars) :].flip(0),
    "the mean of all cars": lambda table, cars: table[cars.detection_row].mean(dim=0),
}
LEAVING = r"hand tensors of the cars to PriorTerm\(values=...\)"


@pytest.mark.parametrize("detections", [(0, 1), (0, 1, 2, 3, 4, 5)], ids=len)
@pytest.mark.parametrize("case", CLOSED)
def test_a_residual_that_mistakes_the_cars_is_named_before_the_first_step(case: str, detections: Sequence[int]) -> None:
    prior, scene = cached_street()
    refiner = DirectShapeRefiner(prior, DEFAULT, [closed_over(CLOSED[case])])
    with pytest.raises(InputError, match=rf"^extra term 'radar' after of.*{LEAVING}"):
        refiner.problem(scene.frames, boxes(*detections))


def test_full_tables_are_named_where_cars_were_refused() -> None:
    detections = boxes()
    behind = detections.T_cam_obj.clone()
    behind[0, 2, 3] = -5.0
    with pytest.raises(InputError, match=rf"^extra term 'radar': linear.*expected values for 5 cars, got .*{LEAVING}"):
        refine(closed_over(CLOSED["all rows"]), detections=replace(detections, T_cam_obj=behind))


def test_a_factory_that_mixes_detections_and_cars_is_named() -> None:
    detections = boxes()
    behind = detections.T_cam_obj.clone()
    behind[0, 2, 3] = -5.0

    def mixing(*scene: Any) -> PriorTerm:
        return PriorTerm("radar", float((scene[1].T_cam_obj[:, 2, 3] / scene[2].input_depth).sum()), *scene[2:4], 1)

    with pytest.raises(InputError, match=r"^extra term of .*mixing: expected values for 5 cars, .*cars.detection_row"):
        refine(mixing, detections=replace(detections, T_cam_obj=behind))


@dataclass(frozen=True)
class Keeping(PriorTerm):
    """A `Keeping` is a term with its own table, which goes with the cars because its field declares so."""

    table: Annotated[Tensor | None, Dense("B", 3)] = None

    def _at(self, state: CarState) -> PriorResidual:
        assert self.table is not None
        return to_radar(self.cars, state, self.table)


@dataclass(frozen=True)
class Undeclared(Keeping):
    """A term that does not say whether its table belongs to the cars."""

    table: Tensor | None = None


def keeping(kind: type[Keeping], change: Callable[[Tensor], Tensor] = lambda x: x) -> TermFactory:
    return lambda *scene: kind("radar", WEIGHT, scene[2], to_radar, 3, table=change(measured(scene[1])))


def test_a_declared_table_goes_with_its_cars() -> None:
    kept = refine(keeping(Keeping), detections=boxes())
    torch.testing.assert_close(kept.T_cam_obj, together().T_cam_obj, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("factory", "message"),
    [
        (radar(name="rader_cam"), ".*unexpected keyword argument 'rader_cam'"),
        (radar(weight=torch.ones(6)), ": weight: expected a number, .*term_weights="),
        (keeping(Undeclared), r": table: expected a declaration of its axes, got none; .*Dense\(\"B\""),
        (keeping(Keeping, lambda x: x[1:]), r": table: expected shape \(6, 3\), got \(5, 3\)"),
    ],
)
def test_other_mistakes_are_named(factory: TermFactory, message: str) -> None:
    with pytest.raises(InputError, match="^extra term 'radar'" + message):
        refine(factory, detections=boxes())
