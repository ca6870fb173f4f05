"""What a suite of the benchmark gives back: rows of figures, and notes on what was not measured."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from benchmark_suites.timing import Repetitions, Spread

Kind = Literal["time", "memory", "accuracy", "ratio", "slope", "count"]
"""What a figure is; ratios, slopes and counts alone mean the same on another machine."""


def _silent(line: str) -> None:
    """Progress that nobody wants to see."""


@dataclass(frozen=True)
class SuiteSettings:
    """How a suite runs.

    Attributes:
        data_root: folder that holds `rendered` and `kitti`, or None for the bundled frame.
        quick: fewer frames, sizes and repetitions; to see that everything runs, not to quote.
        repetitions: of whatever is timed.
        progress: is told, line by line, what is measured next.
    """

    data_root: Path | None = None
    quick: bool = False
    repetitions: Repetitions = field(default_factory=Repetitions)
    progress: Callable[[str], None] = _silent


@dataclass(frozen=True)
class Row:
    """One figure.

    Attributes:
        suite: that measured it.
        name: what of; unique within the suite and the same in every run of it.
        value: the figure, a median wherever it was measured more than once; NaN where there is none.
        unit: "ms", "MB", "" for ratios ...
        kind: what it is.
        low, high: quartiles over the repetitions (or over frames, where the name says so), or None.
        count: repetitions (or frames) behind it.
        better: "lower" or "higher".
        goal: what it should be at most (at least, where higher is better), or None.
        note: what must be known to read it.
        tolerance: by which a baseline lets it become worse; None: as of its kind.
    """

    suite: str
    name: str
    value: float
    unit: str
    kind: Kind
    low: float | None = None
    high: float | None = None
    count: int = 1
    better: Literal["lower", "higher"] = "lower"
    goal: float | None = None
    note: str = ""
    tolerance: float | None = None

    @classmethod
    def of(
        cls, suite: str, name: str, spread: Spread, unit: str, kind: Kind, goal: float | None = None, note: str = ""
    ) -> Row:
        """Median and quartiles of a sample of which less is better."""
        return cls(suite, name, spread.median, unit, kind, spread.low, spread.high, spread.count, goal=goal, note=note)

    @property
    def key(self) -> str:
        """Its name among the rows of all suites."""
        return f"{self.suite}: {self.name}"

    @property
    def meets_goal(self) -> bool | None:
        """None without a goal, or where there is no figure.

        Examples:
            >>> Row("cpu", "per car", 9.5, "ms", "time", goal=10.0).meets_goal
            True
        """
        if self.goal is None or math.isnan(self.value):
            return None
        return self.value <= self.goal if self.better == "lower" else self.value >= self.goal


@dataclass(frozen=True)
class SuiteResult:
    """Everything one suite found.

    Attributes:
        suite: its name.
        rows: figures.
        notes: what was measured on, and what was left out and why, a sentence each.
        without: what this machine cannot measure: words of the names of rows that nobody should miss.
    """

    suite: str
    rows: tuple[Row, ...]
    notes: tuple[str, ...] = ()
    without: tuple[str, ...] = ()
