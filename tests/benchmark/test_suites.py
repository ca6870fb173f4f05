"""Suites at the smallest size: their rows, goals and notes; no test here depends on how fast the machine is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from directshape_torch.benchmark import compile_cost, suite_cpu, suite_gpu
from directshape_torch.benchmark.compile_probe import ProbeResult, probe
from directshape_torch.benchmark.presets import make_refiner
from directshape_torch.benchmark.rows import Row
from directshape_torch.benchmark.run import SUITES
from directshape_torch.benchmark.settings import SuiteSettings
from directshape_torch.benchmark.suite_profile import run_profile
from directshape_torch.benchmark.timing import Repetitions
from directshape_torch.benchmark.workloads import demo_scene, first_cars
from directshape_torch.errors import CompilationError
from directshape_torch.evaluation.bootstrap import Estimate

_ONE_ITERATION = ["stages=[{max_iterations: 1}]"]
SMALLEST = SuiteSettings(quick=True, repetitions=Repetitions(warm_up=0, rounds=1))


def test_speed_and_accuracy_of_one_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(suite_cpu, "_PRESETS", ("fast",))
    for name, modes in (("available_modes", ("eager",)), ("unavailable_modes", ("compiled",))):
        monkeypatch.setattr(suite_cpu, name, lambda modes=modes: modes)
    monkeypatch.setattr(suite_cpu, "compiler_problem", lambda: "no compiler was found")

    result = suite_cpu.run_cpu(SMALLEST)

    rows = {row.name: row for row in result.rows}
    assert rows["demo, fast eager, per frame"].value == pytest.approx(6 * rows["demo, fast eager, per car"].value)
    overlap = rows["demo, fast eager, bird's-eye IoU"]
    assert overlap.value > 0.85
    assert "input 0.700" in overlap.note
    assert "demo: 1 frames with 6 cars" in result.notes
    assert "compiled: not measured, no compiler was found" in result.notes
    assert result.without == ("rendered, ", "kitti, ", "compiled")
    # The one frame eight times, so that the name of the row is true; and each call over the same piece of work.
    batch = "demo, fast eager, 8 frames in a call"
    assert rows[f"{batch}, per frame"].value == pytest.approx(6 * rows[f"{batch}, per car"].value)
    alone, together = (rows[f"demo, {where}fast eager over the yardstick"] for where in ("", "8 frames in a call, "))
    assert alone.kind == together.kind == "ratio"
    assert alone.value > 0
    assert together.value > 0


def test_compiled_overlaps_are_held_to_the_plain_ones() -> None:
    before = Estimate(0.5, 0.4, 0.6)
    found = {"default eager": 0.8, "default compiled": 0.6, "fast eager": 0.0, "fast compiled": 0.0}
    overlaps = {name: (before, Estimate(value, None, None)) for name, value in found.items()}

    rows = suite_cpu._overlap_rows(demo_scene(), {**overlaps, "other eager": None})

    ratios = [row for row in rows if row.kind == "ratio"]
    assert [row.name for row in ratios] == ["demo, default compiled over default eager, bird's-eye IoU"]
    assert ratios[0].value == pytest.approx(0.75)
    assert ratios[0].tolerance == 0.015
    assert len(rows) - len(ratios) == 4


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
    refiner = make_refiner("fast", "eager", _ONE_ITERATION)

    found = probe(refiner, [loaded])

    assert (found.graphs, found.graphs_again) == (0, 0)
    assert found.first_s > 0
    assert found.compile_s == found.first_s - found.again_s


@pytest.mark.skipif(torch.cuda.is_available(), reason="of a machine without a CUDA device")
def test_without_a_graphics_card_the_suite_says_so() -> None:
    result = suite_gpu.run_gpu(SMALLEST)

    assert result.rows == ()
    assert result.notes == ("not measured: PyTorch finds no CUDA device",)


def test_a_device_is_measured_and_compared_with_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """The CPU stands in for the card: it agrees with itself, and never waits."""
    monkeypatch.setattr(suite_gpu, "available_modes", lambda: ("eager",))
    monkeypatch.setattr(suite_gpu, "_busy_share", lambda *_: 0.5)
    monkeypatch.setattr(suite_gpu, "make_refiner", lambda _, mode, __=(): make_refiner("fast", mode, _ONE_ITERATION))
    monkeypatch.setattr(suite_gpu, "_QUICK_BATCH_FRAMES", 2)
    monkeypatch.setattr(torch.cuda, "get_sync_debug_mode", lambda: 0)
    monkeypatch.setattr(torch.cuda, "set_sync_debug_mode", lambda _: None)
    scene = demo_scene()
    scene = replace(scene, frames=(first_cars(scene.frames[0], 1),))

    result = suite_gpu.measure_device(torch.device("cpu"), [scene], SMALLEST)

    values = {row.name: row.value for row in result.rows}
    batch = "demo, default eager, 2 frames in a batch"
    assert values[f"{batch}, per frame"] == pytest.approx(values[f"{batch}, per car"])
    assert values[f"{batch}, peak memory per car"] > 0
    assert values[f"{batch}, card at work"] == 50
    assert values["demo, cars with the CPU's result"] == 1
    assert values["synchronisations a block, eager"] == 0


def test_a_device_without_a_compiler_is_measured_eagerly(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> list[Row]:
        raise CompilationError("no Triton")

    monkeypatch.setattr(suite_gpu, "available_modes", lambda: ("compiled",))
    monkeypatch.setattr(suite_gpu, "_batch_rows", refuse)
    monkeypatch.setattr(suite_gpu, "_agreement_rows", lambda *_: [])

    result = suite_gpu.measure_device(torch.device("cpu"), [demo_scene()], SMALLEST)

    assert result.notes[-1] == "compiled: not measured, no Triton"


def test_the_stages_of_a_profile_add_up() -> None:
    rows = {row.name: row.value for row in run_profile(SMALLEST).rows}

    assert sum(rows.values()) == pytest.approx(2 * rows["whole call"])


def test_every_suite_has_its_module() -> None:
    folder = Path(suite_cpu.__file__).parent

    for module, function in SUITES.values():
        assert f"def {function}(" in (folder / f"{module}.py").read_text(encoding="utf-8")
