"""The benchmark's suites at the smallest size; no test here depends on how fast the machine is."""

from __future__ import annotations

import math
import sys
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from benchmark_suites import checkouts, compile_cost, peers, stage_profile, suite_cpu, suite_gpu, suite_scaling
from benchmark_suites.baseline import (
    Comparison,
    Expected,
    compare,
    make_baseline,
    read_baseline,
    updated,
    write_baseline,
)
from benchmark_suites.compile_cost import ProbeResult, probe
from benchmark_suites.figures import Kind, Row, SuiteResult, SuiteSettings
from benchmark_suites.machine import describe_machine
from benchmark_suites.measures import OperationCount, count_operations, count_synchronisations, peak_tensor_bytes
from benchmark_suites.refiners import make_refiner
from benchmark_suites.report import format_suite, write_run
from benchmark_suites.stage_profile import PARTS, profile_parts, run_profile
from benchmark_suites.timing import InterleavedTimes, Repetitions, Spread, time_interleaved
from benchmark_suites.workloads import demo_scene, first_cars, load_scenes, with_cars

from directshape_torch.errors import CompilationError, DataFormatError, InputError
from directshape_torch.evaluation.bootstrap import Estimate

SMALLEST = SuiteSettings(quick=True, repetitions=Repetitions(warm_up=0, rounds=1))
_ONE_ITERATION = ["stages=[{max_iterations: 1}]"]
_MEGABYTE = 2**20


class FakeClock:
    """Stands still until something takes time."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now

    def takes(self, seconds: float) -> Callable[[], None]:
        def call() -> None:
            self.now += seconds

        return call


# --- times


def test_quartiles_by_hand() -> None:
    # Sorted 1 2 3 4 10: with the ends included the quartiles are the second and the fourth.
    assert Spread.of([10.0, 3.0, 1.0, 4.0, 2.0]) == Spread(3.0, 2.0, 4.0, 5)
    assert Spread.of([7.0]) == Spread(7.0, 7.0, 7.0, 1)


def test_each_side_is_timed_by_itself_after_calls_that_do_not_count() -> None:
    clock = FakeClock()
    times = time_interleaved({"slow": clock.takes(3.0), "fast": clock.takes(0.5)}, Repetitions(1, 4), clock=clock)
    assert times.seconds == {"slow": (3.0,) * 4, "fast": (0.5,) * 4}
    assert clock.now == 5 * 3.5


def test_a_drifting_machine_does_not_change_a_ratio() -> None:
    ratio = InterleavedTimes({"a": (2.0, 3.0, 4.5), "b": (1.0, 1.5, 2.25)}).ratio("a", "b")
    assert (ratio.median, ratio.low, ratio.high) == (2.0, 2.0, 2.0)


def test_the_order_is_reversed_in_every_second_round() -> None:
    called: list[str] = []
    sides = {name: (lambda name=name: called.append(name)) for name in "ab"}
    time_interleaved(sides, Repetitions(warm_up=0, rounds=3))
    assert called == ["a", "b", "b", "a", "a", "b"]


@pytest.mark.parametrize(("budget_s", "rounds"), [(0.0, 1), (25.0, 3), (1000.0, 7)])
def test_the_budget_ends_the_rounds_but_never_the_first(budget_s: float, rounds: int) -> None:
    clock = FakeClock()
    times = time_interleaved({"a": clock.takes(10.0)}, Repetitions(0, 7, budget_s), clock=clock)
    assert len(times.seconds["a"]) == rounds


# --- operations, memory, waits


def test_operations_are_counted_below_python() -> None:
    x = torch.ones(2, 2)
    with OperationCount() as count:
        _ = x + x.mT
    assert count.by_name == {"aten.add": 1, "aten.transpose": 1}
    refiner, call = make_refiner("fast", "eager", _ONE_ITERATION), with_cars(demo_scene().frames, 1)
    refiner(*call)  # makes its constants, once
    assert count_operations(lambda: refiner(*call)) == count_operations(lambda: refiner(*call)) > 500


def test_the_peak_is_of_tensors_alive_at_once() -> None:
    before = torch.zeros(_MEGABYTE)

    def call() -> float:
        a = torch.zeros(_MEGABYTE, dtype=torch.uint8)
        b = torch.zeros(2 * _MEGABYTE, dtype=torch.uint8)
        del a
        c = torch.zeros(_MEGABYTE // 2, dtype=torch.uint8)
        return float(b[0] + c[0])

    # a and b live together (3 MB), then b and c (2.5 MB).
    assert abs(peak_tensor_bytes(call) - 3 * _MEGABYTE) < 1024
    assert 0 < peak_tensor_bytes(before.sum) < 1024


def test_each_warning_of_a_wait_counts_and_the_mode_is_restored(monkeypatch: pytest.MonkeyPatch) -> None:
    modes: list[object] = []
    monkeypatch.setattr(torch.cuda, "get_sync_debug_mode", lambda: 0)
    monkeypatch.setattr(torch.cuda, "set_sync_debug_mode", modes.append)

    def call() -> None:
        for _ in range(3):
            warnings.warn("called a synchronizing CUDA operation (Triggered internally)", UserWarning, stacklevel=1)
        warnings.warn("something else", UserWarning, stacklevel=1)

    assert list(count_synchronisations(call).values()) == [3]
    with pytest.raises(ZeroDivisionError):
        count_synchronisations(lambda: 1 / 0)
    assert modes == ["warn", 0, "warn", 0]


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_reading_a_value_is_one_wait() -> None:
    x = torch.ones(1, device="cuda")
    assert count_synchronisations(x.item).total() == 1
    assert count_synchronisations(lambda: x + 1).total() == 0


# --- what is refined


@pytest.mark.parametrize(("count", "frames"), [(1, 1), (6, 1), (7, 2), (20, 4)])
def test_exactly_so_many_cars_in_as_few_frames_as_hold_them(count: int, frames: int) -> None:
    batch, detections = with_cars(demo_scene().frames, count)
    assert (len(detections), len(batch)) == (count, frames)
    assert torch.equal(detections.frame_index, torch.arange(count) // 6)
    with pytest.raises(InputError, match="at least one car"):
        with_cars([first_cars(demo_scene().frames[0], 0)], count)


def test_without_data_there_is_the_bundled_frame(tmp_path: Path) -> None:
    (scene,) = load_scenes(None)
    assert (scene.name, len(scene.frames), scene.num_cars) == ("demo", 1, 6)
    with pytest.raises(InputError, match="rendered or kitti"):
        load_scenes(tmp_path)


# --- the baseline


def row(name: str, value: float, kind: Kind = "ratio", **others: object) -> Row:
    return replace(Row("cpu", name, value, "", kind), **others)


def compared(rows: list[Row], baseline: dict[str, Expected], without: tuple[str, ...] = ()) -> Comparison:
    return compare([SuiteResult("cpu", tuple(rows), without=without)], baseline)


def test_figures_of_one_machine_are_never_in_a_baseline() -> None:
    kinds: tuple[Kind, ...] = ("ratio", "slope", "count", "time", "memory", "accuracy")
    assert set(make_baseline([row(kind, 2.0, kind) for kind in kinds])) == {"cpu: ratio", "cpu: slope", "cpu: count"}


@pytest.mark.parametrize(
    ("expected", "passes", "fails"),
    [
        (Expected(4.0, "ratio", "lower", 0.25), 5.0, 5.01),  # 4 + a quarter of 4
        (Expected(4.0, "ratio", "higher", 0.25), 3.0, 2.99),
        (Expected(0.9, "slope", "lower", 0.2), 1.09, 1.11),  # absolute
        (Expected(1.0, "count", "lower", 0.0), 1.0, 1.5),
    ],
)
def test_the_limit_by_hand(expected: Expected, passes: float, fails: float) -> None:
    assert expected.allows(passes)
    assert not expected.allows(fails)
    assert not expected.allows(float("nan"))


def test_a_regression_names_row_figure_and_limit() -> None:
    baseline = make_baseline([row("a", 4.0, tolerance=0.25), row("b", 4.0, better="higher"), row("c", 1.0)])
    found = compared([row("a", 6.0), row("b", 100.0, better="higher")], baseline, without=("c",))
    assert found == Comparison(2, ("cpu: a: 6, at most 5 allowed (baseline 4)",), ("cpu: c",))
    # What has vanished has become worse, where its suite ran.
    assert "c: was not measured" in compared([row("a", 4.0), row("b", 4.0)], baseline).regressions[0]
    assert compare([SuiteResult("gpu", ())], baseline) == Comparison(0, (), ())


def test_a_baseline_survives_its_file_and_updates_keep_what_was_set_by_hand(tmp_path: Path) -> None:
    old = {
        "cpu: a": Expected(4.0, "ratio", "lower", 0.9),
        "cpu: gone": Expected(1.0, "ratio", "lower", 0.3),
        "gpu: b": Expected(2.0, "count", "lower", 0.0),
    }
    write_baseline(tmp_path / "b.json", old)
    assert read_baseline(tmp_path / "b.json") == old
    new = updated(old, make_baseline([row("a", 3.0)]), ["cpu"])
    assert new == {"gpu: b": old["gpu: b"], "cpu: a": Expected(3.0, "ratio", "lower", 0.9)}


@pytest.mark.parametrize("text", ["", "[]", '{"schema_version": 99, "rows": {}}', '{"schema_version": 1}'])
def test_a_file_that_is_no_baseline_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "b.json").write_text(text)
    with pytest.raises(DataFormatError, match="no baseline"):
        read_baseline(tmp_path / "b.json")


# --- tables and files


def test_the_table_says_figure_spread_and_whether_the_goal_is_met(tmp_path: Path) -> None:
    rows = (
        Row("cpu", "per car", 12.345678, "ms", "time", 11.0, 14.0, 24, goal=10),
        Row("cpu", "ratio", 5.5, "", "ratio", better="higher", goal=5, note="in one run"),
        Row("cpu", "nothing", math.nan, "ms", "time", goal=1),
    )
    suite = SuiteResult("cpu", rows, notes=("six cars",))
    lines = format_suite(suite).splitlines()
    assert lines[2].split("  ")[0] == "per car"
    assert "12.35 ms  11 .. 14  24  at most 10: MISS" in lines[2]
    assert "at least 5: met" in lines[3]
    assert lines[3].endswith("in one run")
    assert lines[-1] == "note: six cars"
    write_run(tmp_path / "b.json", describe_machine(), "python scripts/benchmark.py", False, [suite])
    assert '"value": null' in (tmp_path / "b.json").read_text()
    assert f"PyTorch {torch.__version__}" in str(describe_machine())


# --- suites


def test_speed_operations_and_accuracy_of_one_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(suite_cpu, "_PRESETS", ("fast",))
    monkeypatch.setattr(suite_cpu, "_BATCH_FRAMES", 2)
    for name, modes in (("available_modes", ("eager",)), ("unavailable_modes", ("compiled",))):
        monkeypatch.setattr(suite_cpu, name, lambda modes=modes: modes)
    monkeypatch.setattr(suite_cpu, "compiler_problem", lambda: "no compiler was found")

    result = suite_cpu.run_cpu(SMALLEST)

    rows = {row.name: row for row in result.rows}
    overlap = rows["demo, fast eager, bird's-eye IoU"]
    assert overlap.value > 0.85
    assert "input 0.700" in overlap.note
    assert "demo: 1 frames with 6 cars" in result.notes
    assert "compiled: not measured, no compiler was found" in result.notes
    assert result.without == ("rendered, ", "kitti, ", "compiled")
    # The one frame twice, so that the name of the row is true.
    for where in ("demo, fast eager", "demo, 2 frames in a call, fast eager"):
        assert rows[f"{where}, per frame"].value == pytest.approx(6 * rows[f"{where}, per car"].value)
        assert rows[f"{where} over the yardstick"].value > 0
    # Frames of a call share its operations.
    alone, together = (rows[f"demo, {w}fast eager, operations of a call"].value for w in ("", "2 frames in a call, "))
    assert alone < together < 1.5 * alone


def test_compiled_overlaps_are_held_to_the_plain_ones() -> None:
    before = Estimate(0.5, 0.4, 0.6)
    found = {"default eager": 0.8, "default compiled": 0.6, "fast eager": 0.0, "fast compiled": 0.0}
    overlaps = {name: (before, Estimate(value, None, None)) for name, value in found.items()}
    rows = suite_cpu._overlap_rows(demo_scene(), {**overlaps, "other eager": None})
    (ratio,) = (row for row in rows if row.kind == "ratio")
    assert ratio.name == "demo, default compiled over default eager, bird's-eye IoU"
    assert (ratio.value, ratio.tolerance) == (pytest.approx(0.75), 0.015)
    assert len(rows) == 5


def test_what_compiling_costs_is_the_first_calls_less_the_second(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[str, Path]] = []

    def run_probe(mode: str, cache: Path, _: SuiteSettings) -> ProbeResult:
        asked.append((mode, cache))
        return ProbeResult(first_s=30.0 / len(asked), again_s=2.0, forms=7, forms_again=0, peak_memory_mb=500.0)

    monkeypatch.setattr(compile_cost, "run_probe", run_probe)
    rows = {row.name: row for row in compile_cost.compile_rows(SMALLEST)}
    assert rows["default, cold compilation"].value == 28.0
    assert rows["default, compilation from a warm disk cache"].value == 13.0
    # The second process finds what the first has left.
    assert [mode for mode, _ in asked] == ["compiled", "compiled", "eager"]
    assert asked[0][1] == asked[1][1]


def test_an_eager_process_compiles_nothing(tmp_path: Path) -> None:
    found = compile_cost.run_probe("eager", tmp_path, SMALLEST)
    assert (found.forms, found.forms_again) == (0, 0)
    assert found.compile_s == found.first_s - found.again_s
    assert found.peak_memory_mb is None or found.peak_memory_mb > 100
    loaded = first_cars(demo_scene().frames[0], 1)
    assert probe(make_refiner("fast", "eager", _ONE_ITERATION), [loaded]).first_s > 0


@pytest.mark.parametrize("power", [-1.0, 0.0, 0.5, 2.0])
def test_the_slope_of_a_power_is_the_power(power: float) -> None:
    x = [1.0, 3.0, 10.0, 50.0]
    assert suite_scaling.slope(x, [7 * value**power for value in x]) == pytest.approx(power, abs=1e-12)


def test_scaling_over_cars(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(suite_scaling, "available_modes", lambda: ("eager",))
    monkeypatch.setattr(suite_scaling, "make_refiner", lambda _, mode: make_refiner("fast", mode, _ONE_ITERATION))
    rows = {row.name: row.value for row in suite_scaling.run_scaling(SMALLEST).rows}
    assert 0 < rows["memory over cars"] < 1.1
    growth = rows["3 cars in a call, peak memory of tensors"] - rows["1 cars in a call, peak memory of tensors"]
    assert rows["memory of a further car"] == pytest.approx(growth / 2)
    assert 1 <= rows["operations, 3 cars over 1, eager"] < 1.5


@pytest.mark.skipif(torch.cuda.is_available(), reason="of a machine without a CUDA device")
def test_without_a_graphics_card_the_suite_says_so() -> None:
    assert suite_gpu.run_gpu(SMALLEST) == SuiteResult("gpu", (), ("not measured: PyTorch finds no CUDA device",))


def test_a_device_is_measured_and_compared_with_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """The CPU stands in for the card: it agrees with itself, and never waits. What is compiled finds no compiler."""

    def refiner(_: str, mode: str, __: tuple[str, ...] = ()) -> object:
        if mode == "compiled":
            raise CompilationError("no Triton")
        return make_refiner("fast", mode, _ONE_ITERATION)

    monkeypatch.setattr(suite_gpu, "available_modes", lambda: ("eager", "compiled"))
    monkeypatch.setattr(suite_gpu, "make_refiner", refiner)
    monkeypatch.setattr(suite_gpu, "_QUICK_BATCH_FRAMES", 2)
    monkeypatch.setattr(torch.cuda, "get_sync_debug_mode", lambda: 0)
    monkeypatch.setattr(torch.cuda, "set_sync_debug_mode", lambda _: None)
    scene = demo_scene()
    scene = replace(scene, frames=(first_cars(scene.frames[0], 1),))
    result = suite_gpu.measure_device(torch.device("cpu"), [scene], SMALLEST)
    values = {row.name: row.value for row in result.rows}
    several = "demo, default eager, 2 frames in a call"
    assert values[f"{several}, per frame"] == pytest.approx(values[f"{several}, per car"])
    assert values[f"{several}, peak memory per car"] > 0
    assert values["demo, cars with the CPU's result"] == 1
    assert values["synchronisations a block, eager"] == 0
    assert result.notes[-1] == "compiled: not measured, no Triton"


# --- the profile


def test_time_belongs_to_the_innermost_function_that_has_a_part(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = FakeClock()

    def helper() -> None:
        clock.takes(2)()

    def inner() -> None:
        clock.takes(1)()
        helper()

    def outer() -> None:
        clock.takes(4)()
        inner()
        clock.takes(8)()

    monkeypatch.setattr(stage_profile, "PARTS", {"inner": (inner,), "outer": (outer,)})
    # The helper's two seconds are its caller's; the time after the call counts as that before it.
    assert profile_parts(outer, clock) == {"inner": 3, "outer": 12, "everything else": 0}
    monkeypatch.setattr(stage_profile, "PARTS", {"inner": (inner,), stage_profile._OUTCOME: (outer,)})
    assert profile_parts(outer, clock)[stage_profile._OUTCOME] == 15


def test_an_error_leaves_no_hook_behind() -> None:
    before = sys.getprofile()
    with pytest.raises(ZeroDivisionError):
        profile_parts(lambda: 1 / 0, lambda: 0.0)
    assert sys.getprofile() is before


def test_no_part_of_a_refinement_is_empty_and_they_add_up() -> None:
    rows = {row.name: row for row in run_profile(SMALLEST).rows}
    assert set(PARTS) < set(rows)
    whole = rows.pop("whole call")
    assert sum(row.value for row in rows.values()) == pytest.approx(whole.value)
    operations = {name: int(row.note.split()[2]) for name, row in rows.items()}
    assert min(operations.values()) > 0
    assert f"{sum(operations.values())} operations" == whole.note
    assert operations["everything else"] < 0.05 * sum(operations.values())


# --- other versions, other solvers


def test_a_version_against_itself() -> None:
    rows = {row.name: row for row in checkouts.run_against(Path(__file__).parents[2], SMALLEST).rows}
    assert rows["demo, one frame in a call, eager, operations"].value == 1
    assert 0.2 < rows["demo, one frame in a call, eager, time"].value < 5


def test_a_folder_that_is_no_version_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--against"):
        checkouts.run_against(tmp_path, SMALLEST)


@pytest.fixture(scope="module")
def task() -> peers.StageTask:
    return peers.stage_tasks(first_cars(demo_scene().frames[0], 2))[-1]


def test_what_other_libraries_are_given_is_the_energy(task: peers.StageTask) -> None:
    for car, energy in enumerate(peers.single_car_energies(task)):
        residuals, wheres = energy.look(energy.start)
        cost = energy.of_squares(residuals.square()).sum() / 2
        torch.testing.assert_close(cost, peers.marched_cost(task, task.start)[car], rtol=1e-5, atol=0)
        # In grey levels and single precision: a surface is polished once more.
        torch.testing.assert_close(energy.residuals(energy.start, wheres), residuals, rtol=1e-3, atol=1e-2)
        # Reweighting: the slope of the summed kernel is that of the cost.
        squared = residuals.square().requires_grad_()
        (weight,) = torch.autograd.grad(energy.of_squares(squared).sum(), squared)
        assert bool((weight >= 0).all())


def test_without_the_library_our_own_rows_remain(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pypose", None)
    few = [first_cars(demo_scene().frames[0], 1)]
    monkeypatch.setattr(peers, "load_scenes", lambda *_: [replace(demo_scene(), frames=few)])
    result = peers.run_peers(SMALLEST)
    assert [row.name for row in result.rows] == [
        "ours, Jacobians by autograd over ours",
        "ours, marched rays over ours",
    ]
    assert result.rows[0].value > 1
    assert "pip install" in result.notes[-1]
    assert result.without == ("PyPose",)


def test_pypose_ends_where_ours_ends(task: peers.StageTask) -> None:
    pytest.importorskip("pypose", reason="needs PyPose: pip install 'directshape_torch[benchmark]'")
    (state,) = peers.pypose_stages([task], [peers.single_car_energies(task)])
    assert bool((peers.marched_cost(task, state) <= 1.05 * peers.marched_cost(task, task.end)).all())
