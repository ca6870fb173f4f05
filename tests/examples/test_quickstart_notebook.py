"""The notebook runs from top to bottom, and its text promises no more than it does."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

NOTEBOOK = Path(__file__).parents[2] / "examples" / "quickstart.ipynb"


def executed(cells: list[dict[str, Any]]) -> dict[str, Any]:
    """The variables after all code cells, each run as the notebook shows it."""
    names: dict[str, Any] = {"__name__": "__main__"}
    for number, cell in enumerate(cells):
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), f"{NOTEBOOK.name}, cell {number}", "exec"), names)
    return names


def test_notebook(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    notebook = json.loads(NOTEBOOK.read_text("utf-8"))
    assert all(not cell["outputs"] for cell in notebook["cells"] if cell["cell_type"] == "code")
    from matplotlib import pyplot

    drawn: list[int] = []
    monkeypatch.setattr(pyplot, "show", lambda: drawn.append(len(pyplot.gcf().axes)))
    try:
        names = executed(notebook["cells"])
    finally:
        pyplot.close("all")
    assert drawn == [1, 1]
    assert "RefinementResult of 6 cars" in capsys.readouterr().out
    # A box that is not trusted is the input.
    assert (names["after_m"][names["result"].refined] < 0.3).all()
    assert names["result"].refined.sum() >= 5
    assert names["after_m"].mean() < 0.5 * names["before_m"].mean()
    # Masks alone are as good as boxes.
    assert names["found_m"].mean() < names["start_m"].mean() < 0.5
    # All seven numbers of a box are trained.
    gradient = names["gradient"]
    assert torch.isfinite(gradient).all()
    assert (gradient != 0).all()
