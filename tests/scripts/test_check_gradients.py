"""These tests check the exit codes, tables and messages of the command, and that it reports a wrong Jacobian."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import check_gradients as script
import pytest
from helpers.priors import first_components

from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.terms.priors import PriorTerm
from directshape_torch.terms.term import Linear

_QUICK = ["--states", "1", "--pixels", "4", "--regime", "far_80m"]


@pytest.fixture(autouse=True)
def _small_prior(monkeypatch: pytest.MonkeyPatch) -> None:
    small = first_components(PCAShapePrior.load_bundled(), 2)
    monkeypatch.setattr(PCAShapePrior, "load_bundled", lambda: small)


def test_tables(capsys: pytest.CaptureFixture[str]) -> None:
    assert script.main([*_QUICK, "--term", "shape", "height"]) == 0
    printed = capsys.readouterr().out
    assert "far_80m" in printed
    assert "| subject | compared | excluded |" in printed
    assert re.search(r"\| shape \| \d+ \| 0 \(0\.00 %\) \|", printed)
    assert "**All bounds hold.**" in printed


def test_a_wrong_jacobian_makes_the_exit_code_one(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    right = PriorTerm.linear

    def negative(self: PriorTerm, *at: Any) -> Linear:
        rows = right(self, *at)
        return rows._replace(J_inner_state=-rows.J_inner_state)

    monkeypatch.setattr(PriorTerm, "linear", negative)
    assert script.main([*_QUICK, "--term", "height", "--no-second"]) == 1
    assert "- height, far_80m: analytic-autograd error 2.0e+00" in capsys.readouterr().out


def test_a_term_of_ones_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As the command names it; a wrong one breaks bounds, and one whose Jacobian has too few rows is wrong use."""
    (tmp_path / "a_term_of_my_own.py").write_text(
        "from directshape_torch.terms.priors import PriorTerm, height_prior\n\n\n"
        "def negative(cars, state):\n    at = height_prior(cars, state)\n"
        "    return at._replace(J_residual_state=-at.J_residual_state)\n\n\n"
        "def wrong(frames, detections, cars, prior):\n"
        "    return PriorTerm('mine', 2.0, cars, negative, 1, ('pose',))\n\n\n"
        "def make(frames, detections, cars, prior):\n"
        "    return PriorTerm('mine', 2.0, cars, height_prior, 1, ('pose',))\n\n\n"
        "def misshapen(frames, detections, cars, prior):\n"
        "    return PriorTerm('mine', 2.0, cars, height_prior, 3, ('pose',))\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    assert script.main([*_QUICK, "--term", "a_term_of_my_own:make"]) == 0
    printed = capsys.readouterr().out
    assert "| mine |" in printed
    assert "gradient of mine" in printed
    assert script.main([*_QUICK, "--term", "a_term_of_my_own:wrong"]) == 1
    assert "- mine, far_80m: analytic-numeric error 2.0e+00" in capsys.readouterr().out
    assert script.main([*_QUICK, "--term", "a_term_of_my_own:misshapen"]) == 2
    assert "extra term 'mine': linear(...).residual: expected shape (1, 3, 1), got (1, 1, 1)" in capsys.readouterr().err


def test_a_term_of_ones_own_with_values_of_each_car(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Handed over as values they pass; rows counted from the first car are wrong as soon as a car is refused."""
    (tmp_path / "a_term_with_values.py").write_text(
        "from directshape_torch.terms.priors import PriorTerm, height_prior\n\n\n"
        "def lower(cars, state, metres):\n    at = height_prior(cars, state)\n"
        "    return at._replace(residual=at.residual - metres)\n\n\n"
        "def right(frames, detections, cars, prior):\n"
        "    metres = detections.T_cam_obj[:, :1, 3]\n"
        "    return PriorTerm('mine', 2.0, cars, lower, 1, ('pose',), values={'metres': metres})\n\n\n"
        "def wrong(frames, detections, cars, prior):\n"
        "    metres = detections.T_cam_obj[:, :1, 3]\n"
        "    first = cars.detection_row - cars.detection_row.min() if len(cars) else cars.detection_row\n"
        "    table = metres[first] if len(cars) else metres\n"
        "    full = metres.new_zeros(len(metres), 1).index_copy(0, cars.detection_row, table[: len(cars)])\n"
        "    return PriorTerm('mine', 2.0, cars, lower, 1, ('pose',), values={'metres': full})\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    quick = ["--regime", "typical", "--pixels", "8", "--no-second", "--states", "3"]
    assert script.main([*quick, "--term", "a_term_with_values:right"]) == 0
    assert script.main([*quick, "--term", "a_term_with_values:wrong"]) == 2
    assert "extra term 'mine' of the cars that were not refused: expected the rows that each" in capsys.readouterr().err


@pytest.mark.parametrize(("option", "message"), [
    (["--term", "fotometric"], "term: expected one of silhouettes, .*photometric, .*got 'fotometric'"),
    (["--term", "no_such_module:f"], "--term: expected module:factory, got 'no_such_module:f'"),
    (["--term", "json:nothing_here"], "--term: expected module:factory, got 'json:nothing_here'"),
    (["--regime", "mars"], "regime: expected one of typical, .*got 'mars'"),
    (["--regime", "code_zero", "--term", "path"], "regime: expected one that has path, got code_zero.*track"),
    (["--states", "0"], "--states: expected at least 1"),
])  # fmt: skip
def test_wrong_use(capsys: pytest.CaptureFixture[str], option: list[str], message: str) -> None:
    assert script.main(option) == 2
    assert re.search(f"error: .*{message}", capsys.readouterr().err)
