"""A benchmark as text for people and as JSON for programs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from benchmark_suites.figures import Row, SuiteResult
from benchmark_suites.machine import Machine
from directshape_torch.config_files import config_to_mapping, load_config
from directshape_torch.evaluation.tables import align
from directshape_torch.files.atomic_files import write_json


def format_suite(result: SuiteResult) -> str:
    """A suite's rows as an aligned table, its notes below.

    Examples:
        >>> print(format_suite(SuiteResult("cpu", (Row("cpu", "a", 2.5, "ms", "time", goal=2),))))
        cpu  value   spread  n  goal             note
        ---  ------  ------  -  ---------------  ----
        a    2.5 ms          1  at most 2: MISS
    """
    rows = [[result.suite, "value", "spread", "n", "goal", "note"]]
    rows += [[r.name, _figure(r.value, r.unit), _spread(r), str(r.count), _goal(r), r.note] for r in result.rows]
    return "\n".join([align(rows), *(f"note: {note}" for note in result.notes)])


def _figure(value: float, unit: str = "") -> str:
    """Four significant digits."""
    text = f"{value:.0f}" if abs(value) >= 1e4 else f"{value:.4g}"
    return f"{text} {unit}".strip()


def _spread(row: Row) -> str:
    return "" if row.low is None or row.high is None else f"{_figure(row.low)} .. {_figure(row.high)}"


def _goal(row: Row) -> str:
    if row.goal is None:
        return ""
    return f"{'at most' if row.better == 'lower' else 'at least'} {row.goal:g}: {'met' if row.meets_goal else 'MISS'}"


def write_run(path: Path, machine: Machine, command_line: str, quick: bool, suites: Sequence[SuiteResult]) -> None:
    """Every figure, the machine, the settings of the presets and the command line as JSON."""
    settings = {name: config_to_mapping(load_config(name)) for name in ("default", "fast")}
    content = {"schema_version": 2, "machine": asdict(machine), "command_line": command_line, "quick": quick}
    write_json(path, content | {"settings": settings, "suites": [_plain(asdict(suite)) for suite in suites]})


def _plain(value: Any) -> Any:
    """JSON knows no NaN: what is not a number is null."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
