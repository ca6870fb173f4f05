"""The benchmark's command line, on the suite that is quickest."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import benchmark
import pytest
from benchmark_suites.baseline import Expected, write_baseline
from benchmark_suites.figures import Row, SuiteResult
from benchmark_suites.machine import describe_machine

RATIO = "cpu: a ratio"
_ROW = Row("cpu", "a ratio", 5.0, "", "ratio")


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The suites that were run, each of which finds the one row."""
    names: list[str] = []

    def run_suite(name: str, _: object) -> SuiteResult:
        names.append(name)
        return SuiteResult(name, (_ROW,) if name == "cpu" else ())

    monkeypatch.setattr(benchmark, "_run_suite", run_suite)
    monkeypatch.delenv("DIRECTSHAPE_DATA", raising=False)
    return names


@pytest.mark.parametrize(("before", "code"), [(1.0, 1), (5.0, 0)])
def test_figures_are_written_and_compared(
    before: float, code: int, measured: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    baseline, out = tmp_path / "baseline.json", tmp_path / "out" / "run.json"
    write_baseline(baseline, {RATIO: Expected(before, "ratio", "lower", 0.3)})
    arguments = ["--suite", "cpu", "--quick", "--json", str(out), "--check", "--baseline", str(baseline)]
    assert benchmark.main(arguments) == code
    assert (f"regression: {RATIO}" in capsys.readouterr().out) == bool(code)
    written = json.loads(out.read_text())
    assert written["quick"]
    assert "--suite cpu" in written["command_line"]
    assert written["suites"][0]["rows"][0]["value"] == 5.0
    assert measured == ["cpu"]


def test_without_a_choice_everything_is_measured_that_needs_nothing_else(measured: list[str]) -> None:
    assert benchmark.main([]) == 0
    assert measured == ["cpu", "scaling", "gpu"]
    assert benchmark.main(["--profile"]) == 0
    assert measured[3:] == ["profile"]


def test_every_suite_is_there() -> None:
    folder = Path(benchmark.__file__).parent / "benchmark_suites"
    for module, function in benchmark.SUITES.values():
        assert f"def {function}(" in (folder / f"{module}.py").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--quick", "--check"], "--check: expected a run without --quick"),
        (["--quick", "--write-baseline", "--baseline", "b.json"], "--write-baseline: expected a run without --quick"),
        (["--threads", "0"], "--threads: expected at least 1, got 0"),
        (["--data", "nowhere", "--profile"], "--data or DIRECTSHAPE_DATA"),
        (["--json", "/proc/version/run.json"], "--json: expected a file in a folder that can be written to"),
        (["--check", "--baseline", "none.json"], "--write-baseline"),
    ],
)
def test_wrong_use_is_told_before_anything_is_measured(
    arguments: list[str], named: str, measured: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert benchmark.main(arguments) == 2
    assert named in capsys.readouterr().err
    assert measured == []


@pytest.mark.usefixtures("measured")
def test_a_check_that_compares_nothing_has_found_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_baseline(tmp_path / "b.json", {RATIO: Expected(5.0, "ratio", "lower", 0.3)})
    assert benchmark.main(["--suite", "gpu", "--check", "--baseline", str(tmp_path / "b.json")]) == 2
    assert "no regression" not in capsys.readouterr().out
    assert benchmark.main(["--suite", "gpu", "--write-baseline", "--baseline", str(tmp_path / "n.json")]) == 2
    assert not (tmp_path / "n.json").exists()


def test_a_busy_machine_is_noted() -> None:
    machine = describe_machine()
    assert not replace(machine, load=machine.cores + 0.2).is_busy
    assert replace(machine, load=machine.cores + 1.0).is_busy
