"""The benchmark's command line, on the suite that is quickest."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import benchmark
import pytest

from directshape_torch.benchmark import run, suite_kernels
from directshape_torch.benchmark.baseline import Expected, write_baseline
from directshape_torch.benchmark.machine import describe_machine
from directshape_torch.benchmark.report import read_run
from directshape_torch.benchmark.rows import SuiteResult

RATIO = "kernels: one iteration over the lookups it needs, eager"


def test_a_quick_run_writes_its_figures_and_fails_against_a_baseline_that_it_cannot_meet(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # Compiling takes longer than a test may.
    monkeypatch.setattr(suite_kernels, "available_modes", lambda: ("eager",))
    baseline, out = tmp_path / "baseline.json", tmp_path / "run.json"
    write_baseline(baseline, {RATIO: Expected(1e-6, "ratio", "lower", 0.3)})

    arguments = ["--suite", "kernels", "--quick", "--json", str(out), "--check", "--baseline", str(baseline)]
    code = benchmark.main(arguments)

    printed = capsys.readouterr()
    assert code == 1
    assert f"regression: {RATIO}" in printed.out
    assert "kernels: parts" in printed.err
    written = read_run(out)
    assert written.quick
    assert "--suite kernels" in written.command_line
    assert all(row.value > 0 for row in written.rows)
    assert RATIO in {row.key for row in written.rows}


def test_quick_figures_are_no_baseline(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert benchmark.main(["--quick", "--write-baseline", "--baseline", str(tmp_path / "b.json")]) == 2
    assert "--write-baseline" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--quick", "--check"], "--check: expected a run without --quick"),
        (["--threads", "0"], "--threads: expected at least 1, got 0"),
        (["--suite", "cpu", "--plots", "out"], "--plots: expected the suite scaling"),
        (["--data", "nowhere", "--profile"], "--data or DIRECTSHAPE_DATA"),
        (["--json", "/proc/version/run.json"], "--json: expected a file in a folder that can be written to"),
    ],
)
def test_wrong_use_is_told_before_anything_is_measured(
    arguments: list[str], named: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("DIRECTSHAPE_DATA", raising=False)
    monkeypatch.setattr(run, "_run_suite", lambda *_: pytest.fail("it was measured"))
    assert benchmark.main(arguments) == 2
    assert named in capsys.readouterr().err


def test_a_check_that_compares_nothing_has_found_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run, "_run_suite", lambda name, _: SuiteResult(name, ()))
    write_baseline(tmp_path / "b.json", {RATIO: Expected(5.0, "ratio", "lower", 0.3)})
    assert benchmark.main(["--suite", "gpu", "--check", "--baseline", str(tmp_path / "b.json")]) == 2
    printed = capsys.readouterr()
    assert "compared 0 rows" in printed.out
    assert "no regression" not in printed.out
    assert benchmark.main(["--suite", "gpu", "--write-baseline", "--baseline", str(tmp_path / "n.json")]) == 2
    assert not (tmp_path / "n.json").exists()


def test_a_busy_machine_is_noted(monkeypatch: pytest.MonkeyPatch) -> None:
    machine = describe_machine()
    for load, notes in ((machine.cores + 0.2, 0), (machine.cores + 1.0, 1)):
        monkeypatch.setattr(run, "describe_machine", lambda load=load: replace(machine, load=load))
        assert len(run._with_note_on_load(SuiteResult("cpu", ())).notes) == notes


def test_a_check_without_a_baseline_says_how_to_make_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert benchmark.main(["--check", "--baseline", str(tmp_path / "none.json")]) == 2
    assert "--write-baseline" in capsys.readouterr().err
