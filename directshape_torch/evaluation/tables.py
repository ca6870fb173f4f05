"""This module formats figures as text tables (aligned columns, units, intervals) and as CSV."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from directshape_torch.evaluation.bootstrap import Estimate
from directshape_torch.files import atomic_files


def align(rows: Sequence[Sequence[str]]) -> str:
    """Lines of text with aligned columns from rows of equally many cells, and a ruled heading from the first row.

    Examples:
        >>> print(align([["metric", "value"], ["F1", "0.5"]]))
        metric  value
        ------  -----
        F1      0.5
    """
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    lines.insert(1, "  ".join("-" * width for width in widths))
    return "\n".join(lines)


def number(unit: str, value: float, sign: bool = False) -> str:
    """A figure with its unit: shares ("%") in percent, degrees ("deg") with two digits, others with three.

    Args:
        unit: "%", "deg", "m", or "" for none.
        value: a share for "%"; a value that is not finite gives a dash.
        sign: whether a positive figure has a plus.

    Examples:
        >>> number("%", 0.125), number("m", 0.5, sign=True), number("", 0.75), number("m", math.nan)
        ('12.5 %', '+0.500 m', '0.750', '-')
    """
    if not math.isfinite(value):
        return "-"
    plus = "+" if sign else ""
    if unit == "%":
        return f"{100 * value:{plus}.1f} %"
    digits = 2 if unit == "deg" else 3
    return f"{value:{plus}.{digits}f}" + (f" {unit}" if unit else "")


def with_interval(unit: str, estimate: Estimate, sign: bool = False) -> str:
    """An estimate in the format of `number`, followed by its interval in brackets if it has one.

    Examples:
        >>> with_interval("%", Estimate(0.5, 0.25, 0.75))
        '50.0 % [25.0, 75.0]'
    """
    value = number(unit, estimate.value, sign)
    if estimate.low is None or estimate.high is None:
        return value
    low, high = (number(unit, bound, sign).split(" ")[0] for bound in (estimate.low, estimate.high))
    return f"{value} [{low}, {high}]"


def write_csv(path: Path | str, rows: Iterable[Sequence[Any]]) -> None:
    """Write rows, the first with the names of columns; numbers have six digits, and non-finite ones are empty."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([_cell(value) for value in row] for row in rows)
    atomic_files.write_text(path, text.getvalue())


def _cell(value: Any) -> Any:
    if isinstance(value, float):
        return f"{value:.6g}" if math.isfinite(value) else ""
    return value
