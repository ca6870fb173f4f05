"""A baseline holds ratios, slopes and counts, and says which of them got worse."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Literal

import pytest

from directshape_torch.benchmark.baseline import (
    Comparison,
    Expected,
    compare,
    make_baseline,
    read_baseline,
    updated,
    write_baseline,
)
from directshape_torch.benchmark.rows import Kind, Row, SuiteResult
from directshape_torch.errors import DataFormatError


def row(
    name: str, value: float, kind: Kind = "ratio", better: Literal["lower", "higher"] = "lower", suite: str = "kernels"
) -> Row:
    return Row(suite, name, value, "", kind, better=better)


def compared(rows: list[Row], baseline: dict[str, Expected]) -> Comparison:
    return compare([SuiteResult("kernels", tuple(rows))], baseline)


def test_absolute_figures_are_never_in_a_baseline() -> None:
    rows = [row("a", 2.0), row("b", 0.9, "slope"), row("c", 1.0, "count")]
    rows += [row("t", 12.0, "time"), row("m", 40.0, "memory"), row("i", 0.9, "accuracy"), row("r", 5.0, "rate")]

    assert set(make_baseline(rows)) == {"kernels: a", "kernels: b", "kernels: c"}


@pytest.mark.parametrize(
    ("expected", "passes", "fails"),
    [
        (Expected(4.0, "ratio", "lower", 0.25), 5.0, 5.01),  # 4 + a quarter of 4
        (Expected(4.0, "ratio", "higher", 0.25), 3.0, 2.99),
        (Expected(0.9, "slope", "lower", 0.2), 1.09, 1.11),  # absolute
        (Expected(1.0, "count", "lower", 0.0), 1.0, 1.5),
    ],
)
def test_the_limit_by_hand(expected: Expected, passes: float, fails: float) -> None:
    assert expected.allows(passes)
    assert not expected.allows(fails)
    assert not expected.allows(float("nan"))


def test_a_row_may_be_held_more_closely_than_its_kind() -> None:
    baseline = make_baseline([row("a", 1.0, better="higher"), replace(row("b", 1.0, better="higher"), tolerance=0.01)])

    found = compared([row("a", 0.97, better="higher"), row("b", 0.97, better="higher")], baseline)

    assert found.regressions == ("kernels: b: 0.97, at least 0.99 allowed (baseline 1)",)


def test_a_better_figure_is_no_regression() -> None:
    baseline = make_baseline([row("a", 4.0), row("b", 4.0, better="higher")])

    assert compared([row("a", 0.1), row("b", 100.0, better="higher")], baseline) == Comparison(2, (), ())


def test_a_regression_names_row_figure_and_limit() -> None:
    baseline = {"kernels: a": Expected(4.0, "ratio", "lower", 0.25)}

    (sentence,) = compared([row("a", 6.0)], baseline).regressions

    assert sentence == "kernels: a: 6, at most 5 allowed (baseline 4)"


def test_a_row_that_vanished_is_a_regression_only_where_its_suite_ran() -> None:
    baseline = make_baseline([row("a", 4.0), row("b", 2.0, suite="gpu")])

    assert compared([row("a", 4.0)], baseline) == Comparison(1, (), ())
    both = [SuiteResult("kernels", (row("a", 4.0),)), SuiteResult("gpu", ())]
    assert "was not measured" in compare(both, baseline).regressions[0]


def test_a_row_that_the_machine_cannot_measure_is_none() -> None:
    """Without a compiler, a data set or another library: named by the suite, and by nobody else."""
    baseline = make_baseline([row("a, eager", 4.0), row("a, compiled", 2.0)])
    eager = (row("a, eager", 4.0),)

    without = compare([SuiteResult("kernels", eager, without=("compiled",))], baseline)

    assert without == Comparison(1, (), ("kernels: a, compiled",))
    assert "a, compiled: was not measured" in compare([SuiteResult("kernels", eager)], baseline).regressions[0]


def test_a_baseline_survives_its_file(tmp_path: Path) -> None:
    baseline = make_baseline([row("a", 4.0), row("b", 0.5, "slope", "higher")])

    write_baseline(tmp_path / "b.json", baseline)

    assert read_baseline(tmp_path / "b.json") == baseline


def test_an_update_keeps_other_suites_and_tolerances_set_by_hand() -> None:
    old = {
        "kernels: a": Expected(4.0, "ratio", "lower", 0.9),
        "kernels: gone": Expected(1.0, "ratio", "lower", 0.3),
        "gpu: b": Expected(2.0, "count", "lower", 0.0),
    }

    new = updated(old, make_baseline([row("a", 3.0)]), ["kernels"])

    assert new == {"gpu: b": old["gpu: b"], "kernels: a": Expected(3.0, "ratio", "lower", 0.9)}


@pytest.mark.parametrize("text", ["", "[]", json.dumps({"schema_version": 99, "rows": {}}), '{"schema_version": 1}'])
def test_a_file_that_is_no_baseline_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "b.json"
    path.write_text(text)

    with pytest.raises(DataFormatError, match="no baseline"):
        read_baseline(path)
