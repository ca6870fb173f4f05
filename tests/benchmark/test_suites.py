"""Suites at the smallest size: their rows, goals and notes; no test here depends on how fast the machine is."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from directshape_torch.benchmark import compile_cost, suite_cpu
from directshape_torch.benchmark.compile_probe import ProbeResult, probe
from directshape_torch.benchmark.presets import make_refiner
from directshape_torch.benchmark.run import SUITES
from directshape_torch.benchmark.settings import SuiteSettings
from directshape_torch.benchmark.suite_gpu import run_gpu
from directshape_torch.benchmark.suite_profile import run_profile
from directshape_torch.benchmark.timing import Repetitions
from directshape_torch.benchmark.workloads import demo_scene, first_cars

SMALLEST = SuiteSettings(quick=True, repetitions=Repetitions(warm_up=0, rounds=1))


def test_speed_and_accuracy_of_one_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(suite_cpu, "_PRESETS", ("fast",))
    monkeypatch.setattr(suite_cpu, "available_modes", lambda: ("eager",))
    monkeypatch.setattr(suite_cpu, "compiler_problem", lambda: "no compiler was found")

    result = suite_cpu.run_cpu(SMALLEST)

    rows = {row.name: row for row in result.rows}
    assert rows["demo, fast eager, per frame"].value == pytest.approx(6 * rows["demo, fast eager, per car"].value)
    overlap = rows["demo, fast eager, bird's-eye IoU"]
    assert overlap.value > 0.85
    assert "input 0.700" in overlap.note
    assert "demo: 1 frames with 6 cars" in result.notes
    assert "compiled: not measured, no compiler was found" in result.notes


def test_what_compiling_costs_is_the_first_calls_less_the_second(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[str, Path]] = []

    def run_probe(_: str, mode: str, cache: Path, __: SuiteSettings) -> ProbeResult:
        asked.append((mode, cache))
        return ProbeResult(first_s=30.0 / len(asked), again_s=2.0, graphs=7, graphs_again=0, peak_memory_mb=500.0)

    monkeypatch.setattr(compile_cost, "run_probe", run_probe)

    rows = {row.name: row for row in compile_cost.compile_rows(SMALLEST)}

    assert rows["default, cold compilation"].value == 28.0
    assert rows["default, compilation from a warm disk cache"].value == 13.0
    assert rows["default, cold compilation"].meets_goal
    assert not rows["default, compilation from a warm disk cache"].meets_goal
    # The second process finds what the first has left.
    assert [mode for mode, _ in asked] == ["compiled", "compiled", "eager"]
    assert asked[0][1] == asked[1][1]


def test_an_eager_process_compiles_nothing() -> None:
    loaded = first_cars(demo_scene().frames[0], 1)
    refiner = make_refiner("fast", "eager", ["stages=[{max_iterations: 1}]"])

    found = probe(refiner, [loaded])

    assert (found.graphs, found.graphs_again) == (0, 0)
    assert found.first_s > 0
    assert found.compile_s == found.first_s - found.again_s


@pytest.mark.skipif(torch.cuda.is_available(), reason="of a machine without a CUDA device")
def test_without_a_graphics_card_the_suite_says_so() -> None:
    result = run_gpu(SMALLEST)

    assert result.rows == ()
    assert result.notes == ("not measured: PyTorch finds no CUDA device",)


def test_the_stages_of_a_profile_add_up() -> None:
    rows = {row.name: row.value for row in run_profile(SMALLEST).rows}

    assert sum(rows.values()) == pytest.approx(2 * rows["whole call"])


def test_every_suite_has_its_module() -> None:
    folder = Path(suite_cpu.__file__).parent

    for module, function in SUITES.values():
        assert f"def {function}(" in (folder / f"{module}.py").read_text(encoding="utf-8")
