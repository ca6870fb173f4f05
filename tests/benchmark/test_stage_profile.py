"""Time by stages: exact on a fake clock, and complete on a real refinement."""

from __future__ import annotations

import pkgutil
from collections.abc import Callable

import pytest

import directshape_torch
from directshape_torch.benchmark.presets import make_refiner
from directshape_torch.benchmark.stage_profile import profile_stages
from directshape_torch.benchmark.stage_rules import RULES, rule_of
from directshape_torch.benchmark.workloads import demo_scene, first_cars


class FakeClock:
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def function_of(module: str, body: str, **names: object) -> Callable[[], None]:
    """A function `f` that believes it belongs to a module."""
    scope: dict[str, object] = {"__name__": module, **names}
    exec(f"def f():\n    {body}", scope)
    found = scope["f"]
    assert callable(found)
    return found


def test_time_belongs_to_the_innermost_function_that_has_a_stage() -> None:
    clock = FakeClock()

    def wait(seconds: float) -> None:
        clock.now += seconds

    helper = function_of("directshape_torch.shape.sdf_grid", "wait(2)", wait=wait)
    depth = function_of("directshape_torch.energy.projected_state", "wait(1); helper()", wait=wait, helper=helper)
    solve = function_of("directshape_torch.solver.damped_solve", "wait(4); depth(); wait(8)", wait=wait, depth=depth)

    profile = profile_stages(solve, clock)

    # The helper's two seconds are its caller's; the solve's time after the call counts as before it.
    assert profile.seconds["silhouette value"] == 3
    assert profile.seconds["solve"] == 12
    assert profile.total_s == 15
    assert profile.share("solve") == pytest.approx(0.8)


def test_a_function_that_no_rule_knows_shows_up_by_name() -> None:
    clock = FakeClock()

    def wait(seconds: float) -> None:
        clock.now += seconds

    renamed = function_of("directshape_torch.brand_new", "wait(3)", wait=wait)

    profile = profile_stages(renamed, clock)

    assert profile.seconds["unattributed"] == 3
    assert profile.unattributed == {"directshape_torch.brand_new.f": 3}


def test_what_the_outcome_evaluates_is_part_of_it() -> None:
    clock = FakeClock()

    def wait(seconds: float) -> None:
        clock.now += seconds

    solve = function_of("directshape_torch.solver.damped_solve", "wait(2)", wait=wait)
    outcome = function_of("directshape_torch.covariance", "solve(); wait(1)", wait=wait, solve=solve)

    assert profile_stages(outcome, clock).seconds["outcome"] == 3


def test_an_error_leaves_no_hook_behind() -> None:
    import sys

    before = sys.getprofile()
    broken = function_of("directshape_torch.solver.damped_solve", "raise ValueError('broken')")

    with pytest.raises(ValueError, match="broken"):
        profile_stages(broken)

    assert sys.getprofile() is before


def test_every_rule_is_of_modules_that_exist() -> None:
    modules = {
        name.removeprefix("directshape_torch.")
        for _, name, _ in pkgutil.walk_packages(directshape_torch.__path__, "directshape_torch.")
    }

    import re

    dead = [rule.module for rule in RULES if not any(re.fullmatch(rule.module, name) for name in modules)]

    assert dead == []


def test_no_stage_of_a_refinement_is_empty_and_hardly_anything_is_unattributed() -> None:
    loaded = first_cars(demo_scene().frames[0], 1)
    refiner = make_refiner("fast", "eager", ["stages=[{max_iterations: 2}]"])

    profile = profile_stages(lambda: refiner(loaded.frame, loaded.detections))

    empty = {stage for stage, seconds in profile.seconds.items() if seconds == 0}
    assert empty <= {"unattributed"}
    assert profile.share("unattributed") < 0.03, profile.unattributed


def test_stages_of_known_functions() -> None:
    package = "directshape_torch"
    assert rule_of(f"{package}.solver.normal_equations", "Segments.accumulate").stage == "normal equations"
    assert rule_of(f"{package}.geometry.se3", "exp").stage is None
    assert rule_of("torch._tensor", "Tensor.__rsub__").stage is None
