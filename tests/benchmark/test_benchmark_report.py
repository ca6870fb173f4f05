"""Tables and JSON of a benchmark."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import pytest

from directshape_torch.benchmark.machine import describe_machine
from directshape_torch.benchmark.report import BenchmarkRun, format_machine, format_suite, read_run, write_run
from directshape_torch.benchmark.rows import Curve, Goal, Row, SuiteResult
from directshape_torch.errors import DataFormatError

ROWS = (
    Row("cpu", "per car", 12.345678, "ms", "time", 11.0, 14.0, 24, goal=Goal("at most", 10)),
    Row("cpu", "ratio", 5.5, "", "ratio", better="higher", goal=Goal("at least", 5), note="in one run"),
)


def a_run() -> BenchmarkRun:
    curve = Curve("cars", "eager", "cars", "time [ms]", (1.0, 2.0), (3.0, 6.0))
    suite = SuiteResult("cpu", ROWS, (curve,), ("six cars",))
    return BenchmarkRun(describe_machine(), "python scripts/benchmark.py", {"default": {"a": 1}}, False, (suite,))


def test_the_table_says_figure_spread_and_whether_the_goal_is_met() -> None:
    lines = format_suite(SuiteResult("cpu", ROWS, notes=("six cars",))).splitlines()

    assert re.split(" {2,}", lines[2].strip()) == ["per car", "12.35 ms", "11 .. 14", "24", "at most 10: MISS"]
    assert "at least 5: met" in lines[3]
    assert lines[3].endswith("in one run")
    assert lines[-1] == "note: six cars"


def test_a_run_survives_its_file(tmp_path: Path) -> None:
    run = a_run()

    write_run(tmp_path / "b.json", run)

    assert read_run(tmp_path / "b.json") == run


def test_a_figure_that_is_not_a_number_is_null_and_misses_no_goal(tmp_path: Path) -> None:
    nothing = Row("cpu", "x", math.nan, "ms", "time", goal=Goal("at most", 1))
    run = a_run()
    run = BenchmarkRun(run.machine, run.command_line, run.settings, True, (SuiteResult("cpu", (nothing,)),))

    write_run(tmp_path / "b.json", run)

    assert json.loads((tmp_path / "b.json").read_text())["suites"][0]["rows"][0]["value"] is None
    assert math.isnan(read_run(tmp_path / "b.json").rows[0].value)
    assert nothing.meets_goal is None
    assert nothing.suite == "cpu"


def test_another_schema_version_is_refused(tmp_path: Path) -> None:
    write_run(tmp_path / "b.json", a_run())
    content = json.loads((tmp_path / "b.json").read_text())
    (tmp_path / "b.json").write_text(json.dumps({**content, "schema_version": 99}))

    with pytest.raises(DataFormatError, match="schema version 1"):
        read_run(tmp_path / "b.json")


def test_the_machine_has_its_parts() -> None:
    machine = describe_machine()

    assert machine.cores >= 1
    assert machine.threads >= 1
    assert f"PyTorch {machine.torch}" in format_machine(machine)
