"""The benchmark runs at its smallest size; no test depends on the speed of the machine."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import benchmark
import pytest
import torch
from benchmark_suites import checkouts, in_turn, workloads
from benchmark_suites.measures import Row, Spread, count_operations, peak_tensor_bytes, time_interleaved
from helpers.car_counts import first_cars


class FakeClock:
    """A `FakeClock` stands still until something takes time."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now

    def takes(self, seconds: float) -> Callable[[], None]:
        def call() -> None:
            self.now += seconds

        return call


def test_quartiles_by_hand() -> None:
    # Sorted 1 2 3 4 10: with the ends included the quartiles are the second and the fourth.
    assert Spread.of([10.0, 3.0, 1.0, 4.0, 2.0]) == Spread(3.0, 2.0, 4.0, 5)


def test_operations_and_tensors_alive_at_once_are_counted() -> None:
    x, mega = torch.ones(2, 2), 2**20
    assert count_operations(lambda: x + x.mT) == 2

    def call() -> float:
        a = torch.zeros(mega, dtype=torch.uint8)
        b = torch.zeros(2 * mega, dtype=torch.uint8)
        del a
        c = torch.zeros(mega // 2, dtype=torch.uint8)
        return float(b[0] + c[0])

    # a and b live together (3 MB), then b and c (2.5 MB).
    assert abs(peak_tensor_bytes(call) - 3 * mega) < 1024


@pytest.mark.parametrize(("read", "of_processor"), [("perf_counter", False), ("process_time", True)])
def test_each_side_is_timed_by_itself_in_an_order_that_turns_round(
    read: str, of_processor: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock, called = FakeClock(), []
    monkeypatch.setattr(f"time.{read}", clock)
    took = {"slow": iter((9.0, 3.0, 4.0, 3.0)), "fast": iter((9.0, 0.5, 0.5, 2.0))}

    def side(name: str) -> Callable[[], None]:
        def call() -> None:
            called.append(name)
            clock.takes(next(took[name]))()

        return call

    sides = {name: side(name) for name in took}
    assert time_interleaved(sides, 3, of_processor=of_processor) == {"slow": 3.0, "fast": 0.5}
    assert called == ["slow", "fast", "slow", "fast", "fast", "slow", "slow", "fast"]


@pytest.fixture
def one_car(monkeypatch: pytest.MonkeyPatch) -> None:
    """The benchmark refines one car of the bundled frame."""
    scene = workloads.demo_scene()
    scene = replace(scene, frames=(first_cars(scene.frames[0], 1),))
    for module in (benchmark, in_turn):
        monkeypatch.setattr(module, "load_scenes", lambda *_: (scene,))


@pytest.mark.usefixtures("one_car")
def test_times_are_told(capsys: pytest.CaptureFixture[str]) -> None:
    assert benchmark.main(["--quick"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert f"PyTorch {torch.__version__}" in lines[0]
    (a_call,) = (line for line in lines if line.startswith("demo, 1 frame in a call, default: ms a call"))
    operations, memory = a_call.split("  ")[-1].split(", ")[:2]
    assert int(operations.split()[0]) > 1_000
    assert 0 < float(memory.split()[0]) < 100


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--threads", "0"], "--threads: expected at least 1, got 0"),
        (["--data", "nowhere"], "--data or DIRECTSHAPE_DATA"),
        (["--against", "nowhere"], "--against"),
    ],
)
def test_wrong_use_is_told(arguments: list[str], named: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert benchmark.main(arguments) == 2
    assert named in capsys.readouterr().err


# --- other versions


@pytest.mark.long
def test_a_version_against_itself() -> None:
    rows: list[Row] = list(checkouts.against_rows(Path(__file__).parents[2], None, quick=True))
    assert [row.name.split(", ")[-1] for row in rows] == ["time", "operations"]
    assert 0.2 < rows[0].spread.median < 5
    assert rows[1].spread.median == 1


# --- native loops


@pytest.mark.usefixtures("one_car")
def test_native_loops_against_tensor_operations() -> None:
    rows: list[Row] = list(in_turn.native_rows(None, quick=True))
    assert [row.name.split(", ")[-1] for row in rows] == ["time", "mm between ends"]
    assert rows[0].spread.median < 1
    assert 0 < rows[1].spread.median < 0.1
    assert rows[1].spread.count == 1
