"""The benchmark's command line, on the suite that is quickest."""

from __future__ import annotations

from pathlib import Path

import benchmark
import pytest

from directshape_torch.benchmark import suite_kernels
from directshape_torch.benchmark.baseline import Expected, write_baseline
from directshape_torch.benchmark.report import read_run

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
    run = read_run(out)
    assert run.quick
    assert "--suite kernels" in run.command_line
    assert all(row.value > 0 for row in run.rows)
    assert RATIO in {row.key for row in run.rows}


def test_quick_figures_are_no_baseline(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert benchmark.main(["--quick", "--write-baseline", "--baseline", str(tmp_path / "b.json")]) == 2
    assert "--write-baseline" in capsys.readouterr().err


def test_a_check_without_a_baseline_says_how_to_make_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert benchmark.main(["--check", "--baseline", str(tmp_path / "none.json")]) == 2
    assert "--write-baseline" in capsys.readouterr().err
