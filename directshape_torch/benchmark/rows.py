"""What a suite of the benchmark gives back: rows of figures, curves to draw, and notes on what was not measured."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

Kind = Literal["time", "rate", "memory", "accuracy", "ratio", "slope", "count"]
"""What a figure is; only those of `COMPARABLE` mean the same on another machine."""

COMPARABLE: frozenset[Kind] = frozenset({"ratio", "slope", "count"})


@dataclass(frozen=True)
class Goal:
    """What a figure should be: at least or at most `value`.

    Example:
        >>> Goal("at most", 10.0).is_met_by(9.5), str(Goal("at most", 10.0))
        (True, 'at most 10')
    """

    side: Literal["at most", "at least"]
    value: float

    def is_met_by(self, value: float) -> bool:
        return value <= self.value if self.side == "at most" else value >= self.value

    def __str__(self) -> str:
        return f"{self.side} {self.value:g}"


@dataclass(frozen=True)
class Row:
    """One figure.

    Attributes:
        suite: that measured it.
        name: what of; unique within the suite and the same in every run of it.
        value: the figure, a median wherever it was measured more than once.
        unit: "ms", "MB", "" for ratios ...
        kind: what it is.
        low, high: quartiles over the repetitions (or over frames, where the name says so), or None.
        count: repetitions (or frames) behind it.
        better: "lower" or "higher".
        goal: what it should be, or None.
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
    goal: Goal | None = None
    note: str = ""
    tolerance: float | None = None

    @property
    def key(self) -> str:
        """Its name among the rows of all suites."""
        return f"{self.suite}: {self.name}"

    @property
    def meets_goal(self) -> bool | None:
        """None without a goal, or where there is no figure."""
        return None if self.goal is None or math.isnan(self.value) else self.goal.is_met_by(self.value)


@dataclass(frozen=True)
class Curve:
    """A figure over a quantity that was varied.

    Attributes:
        panel: of the picture it belongs to; all curves of one panel share their axes.
        name: for the legend.
        x_label, y_label: with units.
        x, y: the points, in order of x.
    """

    panel: str
    name: str
    x_label: str
    y_label: str
    x: tuple[float, ...]
    y: tuple[float, ...]


@dataclass(frozen=True)
class SuiteResult:
    """Everything one suite found.

    Attributes:
        suite: its name.
        rows: figures.
        curves: to be drawn; may be empty.
        notes: what was measured on, and what was left out and why, a sentence each.
        without: what this machine cannot measure: words of the names of rows that nobody should miss.
    """

    suite: str
    rows: tuple[Row, ...]
    curves: tuple[Curve, ...] = ()
    notes: tuple[str, ...] = ()
    without: tuple[str, ...] = ()
