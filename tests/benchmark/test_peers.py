"""The comparison with other libraries: same stages for all, rows of figures, and what is missing is said."""

from __future__ import annotations

import math
import sys
from contextlib import nullcontext
from dataclasses import replace
from typing import Literal

import pytest
import torch
from helpers.peer_stages import street_solver
from helpers.problems import DEFAULT, MARCHED
from helpers.synthetic_scene import cached_street, disturbed

from directshape_torch.benchmark import peers_task
from directshape_torch.benchmark.peers import PeerCase, missing_libraries, notes_on_missing, timed_sides
from directshape_torch.benchmark.peers_rows import Figures, cost_rows, ratio_rows, time_row
from directshape_torch.benchmark.peers_task import (
    OwnSolver,
    StageRun,
    Trace,
    iterations_to,
    stage_tasks,
    with_marched_rays,
)
from directshape_torch.benchmark.rows import Goal
from directshape_torch.benchmark.settings import SuiteSettings
from directshape_torch.benchmark.timing import Repetitions
from directshape_torch.refiner import DirectShapeRefiner


def test_stages_follow_one_another_as_in_a_refinement() -> None:
    prior, scene = cached_street()
    tasks = stage_tasks(street_solver())
    whole = DirectShapeRefiner(prior, DEFAULT)(scene.frames, disturbed(scene.detections))

    assert [task.max_iterations for task in tasks] == [6, 8]
    torch.testing.assert_close(tasks[-1].target_cost, whole.cost_after.sum(dim=1).to(torch.float64), rtol=1e-6, atol=0)


@pytest.mark.parametrize("mode", ["on", "off"])
def test_our_solver_runs_in_the_mode_it_is_told(mode: Literal["on", "off"], monkeypatch: pytest.MonkeyPatch) -> None:
    regions: list[tuple[str, int]] = []

    def recorded(mode: str, num_cars: int) -> nullcontext[None]:
        regions.append((mode, num_cars))
        return nullcontext()

    monkeypatch.setattr(peers_task, "compiling", recorded)
    prior, scene = cached_street()
    OwnSolver(DirectShapeRefiner(prior, replace(DEFAULT, compile=mode)), scene.frames, scene.detections).run()
    assert regions == [(mode, 2)]


def test_iterations_until_near_lead_near() -> None:
    """With marched rays, whose iterations and final costs are of one energy."""
    tasks = stage_tasks(street_solver(marched=True))
    short = [task.near_iterations for task in tasks]
    assert all(1 <= near < task.max_iterations for near, task in zip(short, tasks, strict=True))
    for fewer, reaches in ((0, True), (1, False)):
        runs = street_solver(tasks, max_iterations=[max(1, near - fewer) for near in short], marched=True).run()
        costs = [task.problem.cost(run.state) <= task.near_cost for run, task in zip(runs, tasks, strict=True)]
        assert all(cost.all() for cost in costs) == reaches


@pytest.mark.parametrize(
    ("history", "iterations"),
    [([[2.0, 1.0]], 1), ([[9.0, 2.0, 1.0]], 2), ([[9.0, 2.0, 9.0, 1.0]], 4), ([[9.0, 1.0, math.nan]], 2)],
)
def test_iterations_to_a_cost(history: list[list[float]], iterations: int) -> None:
    assert iterations_to(torch.tensor([3.0]), torch.tensor(history)) == iterations


def test_autograd_ends_where_the_hand_derived_jacobians_end() -> None:
    tasks = stage_tasks(street_solver())
    for run, task in zip(street_solver(tasks, "autograd").run(), tasks, strict=True):
        torch.testing.assert_close(task.problem.cost(run.state), task.target_cost, rtol=1e-6, atol=0)


def test_marched_rays_end_near_by_the_energy_that_others_are_given() -> None:
    prior, scene = cached_street()
    marched = with_marched_rays(DirectShapeRefiner(prior, DEFAULT))
    assert marched.config == MARCHED
    tasks = stage_tasks(street_solver())
    own = OwnSolver(marched, scene.frames, disturbed(scene.detections), [task.start for task in tasks])
    for run, task in zip(own.run(), tasks, strict=True):
        torch.testing.assert_close(task.problem.cost(run.state), task.target_cost, rtol=0.1, atol=0)


def test_seconds_to_a_cost() -> None:
    trace = Trace((0.5, 1.0, 2.0), (30.0, 20.0, 10.0))
    assert [trace.seconds_to(cost) for cost in (25.0, 20.0, 9.0)] == [1.0, 1.0, 2.0]


@pytest.mark.parametrize(("together", "seconds"), [(True, 2.0), (False, 2.5)])
def test_cars_of_a_batch_share_their_seconds(together: bool, seconds: float) -> None:
    traces = (Trace((0.5, 1.0), (3.0, 1.0)), Trace((0.5, 2.0), (9.0, 5.0)))
    run = StageRun(stage_tasks(street_solver())[0].start, torch.tensor([2, 2]), traces, together)
    assert run.seconds_to(torch.tensor([4.0, 6.0])) == seconds


def figures(name: str, seconds: list[float], near: float) -> Figures:
    made = Figures(name, Goal("at least", 10.0), energy_seconds=3.0, all_seconds=4.0)
    made.seconds, made.near_seconds, made.cars = seconds, [near] * len(seconds), [2] * len(seconds)
    made.cost_ratios, made.iterations = [1.0, 0.99, 1.005, 1.2], [7, 8, 9]
    return made


def test_rows_of_a_solver() -> None:
    peer, own = figures("peer", [10.0, 24.0], 5.0), figures("ours", [1.0, 2.0], math.nan)
    time = time_row(peer)
    near_own = figures("ours, near", [0.5, 0.5], math.nan)
    whole, near = ratio_rows(peer, own, near_own, is_goal=True)
    cost, share = cost_rows(peer)

    assert (time.value, time.unit, time.low, time.high) == (8500.0, "ms", 6750.0, 10250.0)
    assert "8 iterations" in time.note
    assert "75 %" in time.note
    assert (whole.name, whole.value, whole.meets_goal) == ("peer over ours", 11.0, True)
    assert (near.name, near.value, near.goal) == ("peer over ours, near our cost", 10.0, None)
    assert (cost.value, cost.note) == (pytest.approx(1.0025), "0.990 to 1.200, cars and stages")
    assert share.value == 0.75


def test_a_solver_that_does_not_say_how_it_went_has_no_row_for_the_way() -> None:
    own = figures("ours", [1.0], math.nan)
    assert [row.name for row in ratio_rows(own, own, own, is_goal=False)] == ["ours over ours"]


def test_a_frame_is_measured_by_all_solvers_in_turn() -> None:
    tasks = stage_tasks(street_solver())
    sides = timed_sides({"own": street_solver(tasks), "again": street_solver(tasks)})
    case = PeerCase("000000", tasks, sides)
    measured = {name: Figures(name) for name in sides}
    settings = replace(SuiteSettings.make(None, quick=True), repetitions=Repetitions(0, 2, 60.0))
    case.measure(measured, settings)

    for each in measured.values():
        assert len(each.seconds) == len(each.cars) == 2
        assert each.cost_ratios == pytest.approx([1.0] * 4, rel=1e-9)
        assert all(math.isnan(s) for s in each.near_seconds)
    assert len(case.costs_in_words()) == 2
    assert f"{tasks[0].target_cost[0]:.3f}" in case.costs_in_words()[0]


def test_a_missing_library_is_named_with_the_error_and_the_cure(monkeypatch: pytest.MonkeyPatch) -> None:
    for library in ("pypose", "theseus"):
        monkeypatch.setitem(sys.modules, library, None)
        monkeypatch.delitem(sys.modules, f"directshape_torch.benchmark.peers_{library}", raising=False)
    missing = missing_libraries()
    notes = notes_on_missing(missing)

    assert set(missing) == {"PyPose", "Theseus", "Theseus, its own differentiation"}
    assert "pypose" in missing["PyPose"]
    assert notes[1].startswith("Theseus: not measured: ModuleNotFoundError")
    assert "pip install --no-build-isolation --no-deps theseus-ai" in notes[-1]


def test_nothing_is_said_where_nothing_is_missing() -> None:
    assert notes_on_missing({}) == []
