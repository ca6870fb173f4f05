"""A benchmark as text for people and as JSON for programs."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from directshape_torch.benchmark.machine import Machine
from directshape_torch.benchmark.rows import Curve, Goal, Row, SuiteResult
from directshape_torch.errors import DataFormatError
from directshape_torch.evaluation.text_table import align
from directshape_torch.io.atomic_files import write_json

SCHEMA_VERSION = 1


@dataclass(frozen=True)
class BenchmarkRun:
    """Everything one call of the benchmark found.

    Attributes:
        machine: it ran on.
        command_line: that started it.
        settings: of the presets that were measured, by name, as nested mappings.
        quick: whether everything was cut short.
        suites: in the order in which they ran.
    """

    machine: Machine
    command_line: str
    settings: dict[str, Any]
    quick: bool
    suites: tuple[SuiteResult, ...]

    @property
    def rows(self) -> tuple[Row, ...]:
        return tuple(row for suite in self.suites for row in suite.rows)


def format_machine(machine: Machine) -> str:
    """A line or two about the machine."""
    parts = [machine.processor, f"{machine.cores} cores", f"{machine.threads} threads of PyTorch"]
    if machine.load is not None:
        parts.append(f"load {machine.load:g}")
    versions = [f"Python {machine.python}", f"PyTorch {machine.torch}", machine.compiler or "no C++ compiler"]
    card = f"{machine.gpu}, CUDA {machine.cuda}" if machine.gpu else "no graphics card"
    return f"{', '.join(parts)}\n{', '.join([*versions, card])}"


def format_suite(result: SuiteResult) -> str:
    """A suite's rows as an aligned table, its notes below.

    Example:
        >>> print(format_suite(SuiteResult("cpu", (Row("cpu", "a", 2.5, "ms", "time", goal=Goal("at most", 2)),))))
        cpu  value   spread  n  goal             note
        ---  ------  ------  -  ---------------  ----
        a    2.5 ms          1  at most 2: MISS
    """
    rows = [[result.suite, "value", "spread", "n", "goal", "note"]]
    rows += [[r.name, _figure(r.value, r.unit), _spread(r), str(r.count), _goal(r), r.note] for r in result.rows]
    return "\n".join([align(rows), *(f"note: {note}" for note in result.notes)])


def _figure(value: float, unit: str) -> str:
    """Four significant digits."""
    text = f"{value:.0f}" if abs(value) >= 1e4 else f"{value:.4g}"
    return f"{text} {unit}".strip()


def _spread(row: Row) -> str:
    if row.low is None or row.high is None:
        return ""
    return f"{_figure(row.low, '')} .. {_figure(row.high, '')}"


def _goal(row: Row) -> str:
    if row.goal is None:
        return ""
    return f"{row.goal}: {'met' if row.meets_goal else 'MISS'}"


def write_run(path: Path | str, run: BenchmarkRun) -> None:
    """Write a run as JSON, whole or not at all."""
    content = {"schema_version": SCHEMA_VERSION, **_plain(asdict(run))}
    write_json(path, content)


def _plain(value: Any) -> Any:
    """JSON knows no NaN: what is not a number is null."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def read_run(path: Path | str) -> BenchmarkRun:
    """Read what `write_run` wrote.

    Raises:
        DataFormatError: it is no such file, or of another schema version.
    """
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
        if content.pop("schema_version") != SCHEMA_VERSION:
            raise ValueError(f"not of schema version {SCHEMA_VERSION}")
        return BenchmarkRun(
            machine=Machine(**content["machine"]),
            command_line=content["command_line"],
            settings=content["settings"],
            quick=content["quick"],
            suites=tuple(_suite(item) for item in content["suites"]),
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        cure = "write it with scripts/benchmark.py --json"
        raise DataFormatError(Path(path), f"is no record of a benchmark: {error}", cure=cure) from error


def _suite(item: dict[str, Any]) -> SuiteResult:
    return SuiteResult(
        item["suite"],
        tuple(map(_row, item["rows"])),
        tuple(map(_curve, item["curves"])),
        tuple(item["notes"]),
        tuple(item.get("without", ())),
    )


def _row(item: dict[str, Any]) -> Row:
    goal = None if item["goal"] is None else Goal(**item["goal"])
    value = math.nan if item["value"] is None else item["value"]
    return Row(**{**item, "goal": goal, "value": value})


def _curve(item: dict[str, Any]) -> Curve:
    return Curve(**{**item, "x": _points(item["x"]), "y": _points(item["y"])})


def _points(values: Sequence[float | None]) -> tuple[float, ...]:
    return tuple(math.nan if value is None else value for value in values)
