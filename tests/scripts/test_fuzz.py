"""The script makes a few calls, damages and disturbances of each kind, and reports a finding."""

from __future__ import annotations

import json
from pathlib import Path

import fuzz
import pytest
from fuzzing import cases
from helpers.bad_children import crashes, hangs

from directshape_torch.errors import InputError


@pytest.mark.parametrize("counts", [
    {"calls": 10, "faults": 100},
    pytest.param({"calls": 1000, "files": 1000, "kills": 4, "faults": 1}, marks=pytest.mark.long),
], ids=["few", "many"])  # fmt: skip
def test_what_was_tried_finds_nothing_and_is_counted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], counts: dict[str, int]
) -> None:
    words = [word for kind, count in counts.items() for word in (f"--{kind}", str(count))]
    assert fuzz.main([*words, "--out", str(tmp_path)]) == 0
    figures = json.loads((tmp_path / "fuzz.json").read_text())
    assert figures.keys() == counts.keys()
    for kind in figures.keys() & {"calls", "files"}:
        assert figures[kind]["accepted"] + figures[kind]["refused"] == counts[kind]
        assert figures[kind]["accepted"] > 0 < figures[kind]["refused"]
    faults = figures["faults"]
    assert faults["told by an error"] > 0
    assert faults["runs that did not go on to the same bytes"] == 0
    assert "calls    refused" in (tmp_path / "fuzz.txt").read_text()
    assert (tmp_path / "fuzz.txt").read_text() in capsys.readouterr().out


@pytest.mark.parametrize(
    ("error", "outcome"),
    [
        (None, "accepted"),
        (InputError("a", "b", "c"), "refused"),
        (MemoryError(), "over memory"),
        (RuntimeError("can't allocate memory: you tried to allocate"), "over memory"),
        (KeyError("x"), "foreign exception"),
    ],
)
def test_what_a_case_ends_with(error: Exception | None, outcome: str) -> None:
    def act() -> bool:
        if error is not None:
            raise error
        return True

    assert cases.answer(lambda _: ("name", act), 7)["outcome"] == outcome
    assert cases.answer(lambda _: ("name", lambda: False), 7)["outcome"] == "silent NaN"


@pytest.mark.parametrize(("child", "outcome"), [(hangs, "hang"), (crashes, "crash")])
def test_children_that_hang_or_crash_are_counted_and_replaced(
    monkeypatch: pytest.MonkeyPatch, child: object, outcome: str
) -> None:
    monkeypatch.setattr(cases, "serve", child)
    figures = cases.tally("calls", (4, 5), 0.5, lambda _: None)
    assert (figures[outcome], [each["seed"] for each in figures["found"]]) == (2, [4, 5])


def test_wrong_use() -> None:
    assert fuzz.main(["--calls", "-1"]) == 2
