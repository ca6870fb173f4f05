"""The script that calls, damages and disturbs by the thousand: a few of each, and what it does with a finding."""

from __future__ import annotations

import json
from pathlib import Path

import fuzz
import pytest
from fuzzing import cases
from fuzzing.children import Tally, tally

from directshape_torch.errors import InputError


def test_a_few_of_each_find_nothing_and_are_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert fuzz.main(["--calls", "10", "--files", "12", "--faults", "40", "--out", str(tmp_path)]) == 0
    figures = json.loads((tmp_path / "fuzz.json").read_text())
    for kind, count in (("calls", 10), ("files", 12)):
        assert figures[kind]["accepted"] + figures[kind]["refused"] == count
        assert figures[kind]["accepted"] > 0 < figures[kind]["refused"]
    faults = figures["faults"]
    assert faults["told by an error"] > 0
    assert faults["runs that did not go on to the same bytes"] == 0
    assert "files    refused" in (tmp_path / "fuzz.txt").read_text()
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


@pytest.mark.parametrize(("code", "outcome"), [("import time; time.sleep(60)", "hang"), ("os._exit(9)", "crash")])
def test_children_that_hang_or_crash_are_counted_and_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: str, outcome: str
) -> None:
    script = tmp_path / "child.py"
    script.write_text(f"import os, sys\nprint('ready', flush=True)\nsys.stdin.readline()\n{code}\n")
    monkeypatch.setattr("fuzzing.children._SCRIPT", script)
    found = tally("calls", iter((4, 5)), 0.5, lambda _: None)
    assert (dict(found.counts), [each["seed"] for each in found.found]) == ({outcome: 2}, [4, 5])
    assert Tally().found == []


def test_wrong_use() -> None:
    assert fuzz.main(["--calls", "-1"]) == 2
