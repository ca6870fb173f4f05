"""The committed baseline: ratios, slopes and counts that must not get worse. Absolute times are never in it."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from benchmark_suites.figures import Kind, Row, SuiteResult
from directshape_torch.errors import DataFormatError
from directshape_torch.files.atomic_files import write_json

_SCHEMA_VERSION = 1

# Ratios wander by a quarter on a busy machine, slopes less and on an absolute scale; counts do not at all. Other kinds
# are of one machine, and in no baseline.
_TOLERANCES: dict[Kind, float] = {"ratio": 0.3, "slope": 0.2, "count": 0.0}


@dataclass(frozen=True)
class Expected:
    """What a row should be.

    Attributes:
        value: it had.
        kind: "ratio", "slope" or "count".
        better: "lower" or "higher".
        tolerance: by which it may be worse: absolute for a slope, else a share of the value.
    """

    value: float
    kind: Kind
    better: Literal["lower", "higher"]
    tolerance: float

    @property
    def limit(self) -> float:
        """The worst value that passes.

        Examples:
            >>> Expected(4.0, "ratio", "higher", 0.25).limit, Expected(2.0, "slope", "lower", 0.5).limit
            (3.0, 2.5)
        """
        allowed = self.tolerance if self.kind == "slope" else self.tolerance * abs(self.value)
        return self.value + allowed if self.better == "lower" else self.value - allowed

    def allows(self, value: float) -> bool:
        return value <= self.limit if self.better == "lower" else value >= self.limit


def make_baseline(rows: Iterable[Row]) -> dict[str, Expected]:
    """What later runs are held to: the comparable rows by key."""
    return {r.key: Expected(r.value, r.kind, r.better, _tolerance(r)) for r in rows if r.kind in _TOLERANCES}


def _tolerance(row: Row) -> float:
    return _TOLERANCES[row.kind] if row.tolerance is None else row.tolerance


@dataclass(frozen=True)
class Comparison:
    """Rows of a run beside those of a baseline.

    Attributes:
        num_compared: rows that both have.
        regressions: a sentence for every row that is worse than the baseline allows, or that has vanished.
        not_measured: keys of rows that this machine cannot measure.
    """

    num_compared: int
    regressions: tuple[str, ...]
    not_measured: tuple[str, ...]


def compare(suites: Iterable[SuiteResult], baseline: dict[str, Expected]) -> Comparison:
    """What has become worse.

    Args:
        suites: of this run; rows of others are not expected, nor is what a suite was `without`.
        baseline: by key.
    """
    ran = {suite.suite: suite for suite in suites}
    found = {row.key: row for suite in ran.values() for row in suite.rows}
    compared, sentences, not_measured = 0, [], []
    for key, expected in baseline.items():
        name, _, row = key.partition(": ")
        if name not in ran:
            continue
        if key in found:
            compared += 1
            if not expected.allows(found[key].value):
                side = "at most" if expected.better == "lower" else "at least"
                allowed = f"{side} {expected.limit:.3g} allowed (baseline {expected.value:.3g})"
                sentences.append(f"{key}: {found[key].value:.3g}, {allowed}")
        elif any(word in row for word in ran[name].without):
            not_measured.append(key)
        else:
            sentences.append(f"{key}: was not measured; the baseline has {expected.value:.3g}")
    return Comparison(compared, tuple(sentences), tuple(not_measured))


def write_baseline(path: Path | str, baseline: dict[str, Expected]) -> None:
    """Write a baseline; rows of suites that did not run are to be among what is given."""
    rows = {key: asdict(expected) for key, expected in baseline.items()}
    write_json(path, {"schema_version": _SCHEMA_VERSION, "rows": rows})


def read_baseline(path: Path | str) -> dict[str, Expected]:
    """Read what `write_baseline` wrote.

    Raises:
        DataFormatError: no such file, or of another schema version.
    """
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
        if content["schema_version"] != _SCHEMA_VERSION:
            raise ValueError(f"not of schema version {_SCHEMA_VERSION}")
        return {key: Expected(**row) for key, row in content["rows"].items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        cure = "make one with scripts/benchmark.py --write-baseline"
        raise DataFormatError(Path(path), f"is no baseline: {error}", cure=cure) from error


def updated(old: dict[str, Expected], new: dict[str, Expected], suites: Iterable[str]) -> dict[str, Expected]:
    """The old baseline with the rows of these suites replaced; a tolerance once set by hand stays."""
    ran = set(suites)
    kept = {key: expected for key, expected in old.items() if key.partition(": ")[0] not in ran}
    for key, expected in new.items():
        tolerance = old[key].tolerance if key in old else expected.tolerance
        kept[key] = Expected(expected.value, expected.kind, expected.better, tolerance)
    return kept
